"""The memory-mapped map."""
