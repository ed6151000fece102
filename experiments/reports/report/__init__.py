"""The report of a result: one HTML file that shows it all and needs nothing else."""
