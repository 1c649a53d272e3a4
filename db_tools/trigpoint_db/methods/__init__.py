"""Other ways to a frame's pose than the localizer's, for comparison: one module each."""
