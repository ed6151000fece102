"""Other people's aligners: one thin adapter a file, behind the extra `[peers]`."""
