"""HTML report of a result, complete in one file."""
