"""HTML report of a result, in one file that works offline."""
