"""Terminal screens of the commands."""
