"""`python -m experiments` is the command `mapfusion`."""

from experiments.cli.main import main

main()
