"""Where poses go: the network and the log."""
