"""The localizer against hloc, and against its own claims."""
