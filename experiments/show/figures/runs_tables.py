"""What figures 4 to 6 ask of a result, of several runs."""

from functools import cached_property
from pathlib import Path

import pandas as pd

from experiments.show.figures.result_tables import NothingToDraw, Pair, in_display_order, pairs_in


class RunsTables:
    """Many runs of one scenario and setting, in place of a `ResultTables`.

    Attributes:
        pictures: the folder that figures go to.
    """

    def __init__(self, pictures: Path, run_medians: pd.DataFrame, timings: pd.DataFrame) -> None:
        self.pictures = pictures
        self._tables = {"errors": run_medians, "aligner_timings": timings}

    def table(self, name: str) -> pd.DataFrame:
        """`errors` with one row per run where results have one per repetition, or the timings."""
        if not len(self._tables[name].columns):
            raise NothingToDraw(f"no run has a table {name}")
        return self._tables[name]

    @cached_property
    def pairs(self) -> list[Pair]:
        """Robot pairs that were aligned."""
        return pairs_in(self.table("errors"))

    @cached_property
    def aligners(self) -> list[str]:
        """Aligners in the order of their appearance, the oracle last."""
        return in_display_order(self.table("errors")["aligner"].drop_duplicates().tolist())

    def label_of(self, aligner: str) -> str:
        """An aligner's name in legends."""
        return aligner

    @property
    def bands_over(self) -> str:
        """What the bands are quantiles of."""
        return f"{self.table('errors')['run_id'].nunique()} runs"
