"""The command `mapfusion`: words in, exit codes out. Heavy imports sit inside the commands."""
