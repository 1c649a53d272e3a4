"""Surveys from other programs, as posed images."""
