"""The command `statistics`: load, compute, write, show."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from experiments.show.export import write_tables
from experiments.show.figures.drawing import draw_figure
from experiments.show.figures.result_tables import ResultTables
from experiments.show.json_document import publish
from experiments.show.terminal.statistics_screen import print_summary
from experiments.study.statistics.run_tables import find_runs
from experiments.study.statistics.summary import ALL_SCENARIOS, Summary, configurations, summarise
from mapfusion.errors import InputError

_FIGURES = ("fig04_translation_error", "fig05_rotation_error", "fig06_aligner_time")


def run_statistics(paths: Sequence[Path], output: Path | None, as_json: bool = False) -> None:
    """Show the main tables; write all, and figures 4 to 6, where an output folder is given.

    As JSON, all tables are shown.

    Raises InputError where a path holds no runs, no run knows the truth, or a table is damaged.
    """
    summary = summarise(find_runs(paths))
    if not {"success_at_the_end", "paths"} & summary.tables.keys():
        where = ", ".join(map(str, paths))
        raise InputError(f"{where}: no truth is known, so there are no errors to count")
    skipped: list[str] = []
    if output is not None:
        write_tables(output, summary.tables)
        skipped += _draw_over_runs(summary, output / "figures")
    if as_json:
        told = {"n_runs": summary.n_runs, "n_configurations": summary.n_configurations}
        told |= {"missing_tables": summary.missing, "failed_runs": summary.failed}
        publish("statistics", told | {"written": output, "tables": summary.tables}, shown=True)
    else:
        print_summary(summary, output, skipped)


def _draw_over_runs(summary: Summary, folder: Path) -> Iterator[str]:
    """Draw what several runs of each scenario and setting share; yields what was not drawn.

    With one such configuration the pictures go to `folder`, with more to a folder each in it.
    """
    drawn = {
        "-".join([labels.pop("scenario"), *(f"{key}={labels[key]}" for key in labels)]): medians
        for labels, medians in configurations(summary.run_medians)
        if labels["scenario"] != ALL_SCENARIOS
    }
    for name, medians in drawn.items():
        runs, timings = medians["run_id"].unique(), summary.timings
        if len(runs) < 2:
            yield f"{name}: one run alone; `mapfusion report --figures` draws it"
            continue
        if len(timings):
            timings = timings[timings["run_id"].isin(runs)]
        # Settings may hold anything; file names may not.
        target = folder if len(drawn) == 1 else folder / re.sub(r"[^\w.=-]", "_", name)[:120]
        data = ResultTables(target, {"errors": medians, "aligner_timings": timings})
        for figure in _FIGURES:
            yield from (f"{name}, {line}" for line in draw_figure(data, figure, target).skipped)
