"""Measure maps: their profiles, and retrieval in large ones."""
