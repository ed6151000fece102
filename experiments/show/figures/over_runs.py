"""Figures 4 to 6 over several runs: medians and bands over seeds instead of repetitions."""

from pathlib import Path
from typing import Any

from experiments.show.figures.drawing import draw_figure
from experiments.show.figures.result_tables import ResultTables
from experiments.study.statistics.summary import ALL_SCENARIOS, Summary, configurations

_OVER_RUNS = ("fig04_translation_error", "fig05_rotation_error", "fig06_aligner_time")


def draw_over_runs(summary: Summary, folder: Path) -> list[str]:
    """Draw figures 4 to 6 of each scenario and setting that has several runs.

    With one such configuration the pictures go to `folder`, with more to a folder each in it.

    Returns:
        One line for each figure that was not drawn.
    """
    skipped = []
    drawn = [
        (_name(labels), rows)
        for labels, rows in configurations(summary.run_medians)
        if labels["scenario"] != ALL_SCENARIOS
    ]
    for name, medians in drawn:
        if medians["run_id"].nunique() < 2:
            skipped.append(f"{name}: one run alone; `mapfusion figures` draws it")
            continue
        timings = summary.timings
        if len(timings):
            timings = timings[timings["run_id"].isin(medians["run_id"].unique())]
        target = folder if len(drawn) == 1 else folder / _file_name(name)
        data = ResultTables(target, {"errors": medians, "aligner_timings": timings})
        outcomes = [draw_figure(data, figure, target) for figure in _OVER_RUNS]
        skipped += [f"{name}, {each.name}: {each.skipped}" for each in outcomes if each.skipped]
    return skipped


def _name(labels: dict[str, Any]) -> str:
    (_, scenario), *settings = labels.items()
    return "-".join([str(scenario), *(f"{key}={value}" for key, value in settings)])


def _file_name(name: str) -> str:
    """Settings may hold anything; file names may not."""
    return "".join(c if c.isalnum() or c in "._=-" else "_" for c in name)[:120]
