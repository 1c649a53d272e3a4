"""Trigpoint: where am I, from pictures. The library: pure computation."""
