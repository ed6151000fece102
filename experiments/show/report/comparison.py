"""The aligners of one or more runs compared: what reports of results and of sweeps share."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from experiments.judge.criteria import ANSWERABLE_PAIRS
from experiments.judge.judged_maps import maps_of, setting_columns
from experiments.show.figures.style import aligner_styles
from experiments.show.report.curves import success_curves, time_curves
from experiments.show.report.theme import chart_style
from experiments.show.report.words import correct_text, words_for
from experiments.study.statistics.error_bands import BAND
from experiments.study.statistics.overlap import with_overlap_share
from experiments.study.statistics.run_tables import Runs
from experiments.study.statistics.standing import Recommendation, recommend
from mapfusion.align.result import Status
from mapfusion.errors import InputError


@dataclass(frozen=True)
class Comparison:
    """All aligners on the maps of some runs.

    Attributes:
        aligners: names in display order, the oracle last.
        maps: rows of `maps_of`.
        verdict: which aligner to use.
        timings: the table `aligner_timings`; empty where no run has it.
    """

    aligners: list[str]
    maps: pd.DataFrame
    verdict: Recommendation
    timings: pd.DataFrame

    @property
    def colours(self) -> list[str]:
        """Of the aligners' lines."""
        return [style["hex"] for style in styled(self.aligners)]

    def contents(self) -> dict[str, Any]:
        """The parts of a report that come from the comparison alone."""
        pairs = self.maps[["scenario", "robot_a", "robot_b"]].drop_duplicates()
        return {
            "verdict": self.verdict,
            "words": words_for(self.verdict, len(pairs), setting_columns(self.maps)),
            "correct_text": correct_text(),
            "aligners": styled(self.aligners),
        }

    def chart_data(self, groups: list[dict[str, Any]]) -> dict[str, Any]:
        """What the charts are drawn from, with the error curves of some groups of maps."""
        return {
            "aligners": styled(self.aligners),
            "groups": groups,
            "success": success_curves(self.maps, self.aligners),
            "times": time_curves(self.timings, self.aligners) if len(self.timings) else {},
            "min_true_pairs": ANSWERABLE_PAIRS,
            "band_text": band_text(),
            "map": None,
        }


def styled(aligners: Sequence[str]) -> list[dict[str, Any]]:
    """Each aligner with its colour, dash and marker."""
    styles = aligner_styles(aligners)
    return [{"name": name, **chart_style(styles[name])} for name in aligners]


def band_text() -> str:
    """What the bands of error curves hold."""
    return f"{100 * BAND[0]:g}–{100 * BAND[1]:g}\u00a0%"


def with_acceptance(errors: pd.DataFrame) -> pd.DataFrame:
    """Errors with a column `accepted`: the least squares' word, where no test was applied."""
    if "accepted" in errors:
        return errors
    return errors.assign(accepted=errors["refined_status"] == "accepted")


def present(errors: pd.DataFrame) -> pd.DataFrame:
    """The rows of aligners that could be run; an absent package is no failure."""
    return errors[errors["status"] != Status.ABSENT]


def compare(runs: Runs, reduced: Sequence[pd.DataFrame], aligners: list[str]) -> Comparison:
    """Judge all aligners.

    Args:
        runs: where the tables are.
        reduced: rows of `reduce_errors`, run by run.
        aligners: in display order.
    """
    if not reduced:
        where = ", ".join(str(folder) for folder in runs.folders)
        raise InputError(f"{where}: no pair of maps was aligned, there is nothing to report on")
    maps = with_overlap_share(pd.concat(reduced, ignore_index=True), runs)
    timings = runs.read("aligner_timings") if runs.has("aligner_timings") else pd.DataFrame()
    return Comparison(aligners, maps, recommend(maps, timings, aligners), timings)


def reduce_errors(errors: pd.DataFrame) -> pd.DataFrame:
    """One row per pair of maps and aligner."""
    return maps_of(with_acceptance(errors))
