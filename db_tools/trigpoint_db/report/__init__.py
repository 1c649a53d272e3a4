"""One self-contained HTML page on a map, or on results."""
