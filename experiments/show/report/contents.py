"""All that a report shows of one or several runs, as values for the template; nothing is drawn."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.judge.criteria import that_ever_meet
from experiments.judge.judged_maps import maps_of, setting_columns
from experiments.judge.result import require_result
from experiments.show.figures.result_tables import (
    ResultTables,
    in_display_order,
    of_pair,
    pairs_in,
)
from experiments.show.figures.style import aligner_styles
from experiments.show.report.charts import error_curves, success_curves, time_curves
from experiments.show.report.one_run_sections import one_run_sections
from experiments.show.report.origin import natural, provenance_of, stage_times
from experiments.show.report.recommendation_text import recommendation_text
from experiments.show.report.theme import chart_style
from experiments.study.statistics.error_bands import medians_of_run
from experiments.study.statistics.overlap import with_overlap_share
from experiments.study.statistics.run_tables import Runs, find_runs
from experiments.study.statistics.standing import recommend
from experiments.study.statistics.summary import ALL_SCENARIOS, configurations
from mapfusion.align.result import Status
from mapfusion.errors import InputError


@dataclass(frozen=True)
class _JudgedRuns:
    """The errors of all runs, reduced.

    Attributes:
        maps: rows of `maps_of`, with the overlap.
        spread: what bands are taken over: all repetitions of one run, the medians of several.
        aligners: that ran, in display order, the oracle last.
        absent: whose package is not installed, which is no failure.
    """

    maps: pd.DataFrame
    spread: pd.DataFrame
    aligners: list[str]
    absent: list[str]


def contents_of(path: Path) -> dict[str, Any]:
    """What the report of a result folder, or of a sweep, shows.

    Raises:
        InputError: neither, or a table is damaged.
    """
    runs = find_runs(path)
    data = None
    if not runs.sweeps:
        require_result(path)
        data = ResultTables(path)
    judged = _read_judged(runs, data)
    provenance, stages = provenance_of(path, runs)
    contents = {
        "provenance": provenance,
        "stages": stages,
        "stage_times": stage_times(runs),
        "failed": runs.failed.to_dict("records"),
        **_comparison(runs, judged, one_run=data is not None),
    }
    return contents | (_of_sweep(path, judged) if data is None else one_run_sections(data))


def _read_judged(runs: Runs, data: ResultTables | None) -> _JudgedRuns:
    """Runs are read and reduced one by one."""
    maps, spread = [], []
    every: dict[str, None] = {}
    for whole in runs.each("errors") if runs.has("errors") else ():
        every |= dict.fromkeys(whole["aligner"])
        errors = whole[whole["status"] != Status.ABSENT]
        if len(errors):
            maps.append(maps_of(errors))
            spread.append(medians_of_run(errors) if data is None else errors)
    if not maps:
        where = ", ".join(str(folder) for folder in runs.folders)
        raise InputError(f"{where}: no pair of maps was aligned, there is nothing to report on")
    joined = pd.concat(spread, ignore_index=True)
    ordered = in_display_order(list(every)) if data is None else data.aligners
    there = set(joined["aligner"])
    return _JudgedRuns(
        maps=with_overlap_share(pd.concat(maps, ignore_index=True), runs),
        spread=joined,
        aligners=[name for name in ordered if name in there],
        absent=[name for name in ordered if name not in there],
    )


def _of_sweep(path: Path, judged: _JudgedRuns) -> dict[str, Any]:
    """Title of a sweep, and the sections that it has not."""
    none: dict[str, Any] = dict.fromkeys(("outcomes", "robots", "fits", "figures", "missing"), ())
    return none | {
        "title": f"{path.name}, {judged.maps['run_id'].nunique()} runs",
        "description": ", ".join(judged.maps["scenario"].unique()),
        "spread_text": "runs; each run is the median of its repetitions",
        "map": None,
        "robot_colours": {},
        "scenario_text": "",
    }


def _comparison(runs: Runs, judged: _JudgedRuns, one_run: bool) -> dict[str, Any]:
    """The aligners compared: words, table and charts."""
    maps, aligners = judged.maps, judged.aligners
    timings = runs.read("aligner_timings") if runs.has("aligner_timings") else pd.DataFrame()
    ranking = recommend(maps, timings, aligners)
    n_robot_pairs = len(maps[["scenario", "robot_a", "robot_b"]].drop_duplicates())
    styles = aligner_styles(aligners)
    groups = _by_robots(judged.spread) if one_run else _by_configuration(judged.spread)
    return {
        "ranking": ranking,
        "words": recommendation_text(ranking, n_robot_pairs, setting_columns(maps)),
        "aligners": [{"name": name, **chart_style(styles[name])} for name in aligners],
        "absent": judged.absent,
        "groups": [{"label": label, "curves": error_curves(r, aligners)} for label, r in groups],
        "success": success_curves(maps, aligners),
        "times": time_curves(timings, aligners) if len(timings) else {},
    }


def _by_robots(errors: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Errors of each pair of robots, and of all together, with a label each."""
    pairs = pairs_in(errors)
    for a, b in pairs:
        yield f"{a} – {b}", of_pair(errors, (a, b))
    if len(pairs) > 1:
        yield "all pairs", errors


def _by_configuration(spread: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Runs of each scenario and setting, with a label each."""
    ordered = sorted(configurations(spread), key=lambda each: [*map(natural, each[0].values())])
    for labels, rows in ordered:
        scenario = labels.pop("scenario")
        if scenario == ALL_SCENARIOS:
            n_before, rows = len(rows), that_ever_meet(rows)
            scenario = "(all)" if len(rows) == n_before else "(all with common ground)"
        settings = [f"{name.rpartition('.')[2]} {value}" for name, value in labels.items()]
        yield ", ".join([scenario, *settings]), rows
