"""Command line `mapfusion`. Heavy imports sit inside the commands."""
