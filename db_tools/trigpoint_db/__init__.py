"""Off-line tools on maps, recordings and results."""
