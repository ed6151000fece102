"""All that a report shows of one or several runs, as values for the template; nothing is drawn."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.judge.criteria import that_ever_meet
from experiments.judge.judged_maps import methods_in, setting_columns
from experiments.judge.result import require_result
from experiments.show.figures.result_tables import ResultTables, of_pair, pairs_in
from experiments.show.figures.style import aligner_styles
from experiments.show.report.charts import error_curves, success_curves, time_curves
from experiments.show.report.one_run_sections import one_run_sections
from experiments.show.report.origin import natural, provenance_of, stage_times
from experiments.show.report.recommendation_text import recommendation_text
from experiments.show.report.theme import chart_style
from experiments.study.statistics.run_tables import Runs, find_runs
from experiments.study.statistics.standing import recommend
from experiments.study.statistics.summary import ALL_SCENARIOS, configurations, reduced_errors
from mapfusion.errors import InputError


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
    if not runs.has("errors") or (reduced := reduced_errors(runs)).maps.empty:
        raise InputError(f"{path}: no pair of maps was aligned, there is nothing to report on")
    aligners = methods_in(reduced.maps, oracle=True)
    if data is None:
        own, groups = _of_sweep(path, reduced.maps), _by_configuration(reduced.medians)
    else:
        aligners = [name for name in data.aligners if name in aligners]
        own, groups = one_run_sections(data), _by_robots(runs.read("errors"))
    provenance, stages = provenance_of(path, runs)
    return own | {
        **_ranking(runs, reduced.maps, aligners),
        "groups": [{"label": label, "curves": error_curves(r, aligners)} for label, r in groups],
        "absent": reduced.absent,
        "provenance": provenance,
        "stages": stages,
        "stage_times": stage_times(runs),
        "failed": runs.failed.to_dict("records"),
    }


def _of_sweep(path: Path, maps: pd.DataFrame) -> dict[str, Any]:
    """Title of a sweep, and the sections that it has not."""
    none: dict[str, Any] = dict.fromkeys(("outcomes", "robots", "fits", "figures", "missing"), ())
    return none | {
        "title": f"{path.name}, {maps['run_id'].nunique()} runs",
        "description": ", ".join(maps["scenario"].unique()),
        "spread_text": "runs; each run is the median of its repetitions",
        "map": None,
        "robot_colours": {},
        "scenario_text": "",
    }


def _ranking(runs: Runs, maps: pd.DataFrame, aligners: list[str]) -> dict[str, Any]:
    """The aligners compared on all maps: words, table and charts."""
    timings = runs.read("aligner_timings") if runs.has("aligner_timings") else pd.DataFrame()
    ranking = recommend(maps, timings, aligners)
    n_robot_pairs = len(maps[["scenario", "robot_a", "robot_b"]].drop_duplicates())
    styles = aligner_styles(aligners)
    return {
        "ranking": ranking,
        "words": recommendation_text(ranking, n_robot_pairs, setting_columns(maps)),
        "aligners": [{"name": name, **chart_style(styles[name])} for name in aligners],
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
