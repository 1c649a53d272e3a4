"""The Trigpoint daemon: everything that waits."""
