"""The daemon as a process: what it adds to the localizer's time, and a long run."""
