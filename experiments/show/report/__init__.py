"""The report of a result: one HTML file that shows it all and needs nothing else."""

from experiments.show.report.document import write_report

__all__ = ["write_report"]
