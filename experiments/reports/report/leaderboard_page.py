"""Page, tables and screen of a leaderboard."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from experiments.evaluation.alignment_criteria import MERGEABLE_PAIRS, RICH_PAIRS
from experiments.pipeline.tables import write_rows
from experiments.reports.export import write_text
from experiments.reports.layout import Column, interval, number, print_frame, print_lines
from experiments.reports.report.charts import NEUTRAL, escaped, faint, rounded
from experiments.reports.report.document import write_page
from experiments.reports.study_files import write_provenance
from experiments.studies.leaderboard import (
    ALIGNER_RANKS,
    ALIGNMENTS,
    FUSER_RANKS,
    FUSIONS,
    REFERENCE_ALIGNER,
    REFERENCE_FUSER,
    RUNS_TO_RANK,
    Leaderboard,
)
from mapfusion.align.alignment import Status

# Headings and formats of the columns, on the screen and on the page.
ALIGNER_COLUMNS: dict[str, Column] = {
    "rank": ("rank", "d"),
    "aligner": ("aligner", ""),
    "decisions": ("right\ndecisions", ".1%"),
    "false_merges": ("false\nmerges", "d"),
    "missed": ("missed", "d"),
    "estimated_ratio": ("error over\noracle's", ".2f"),
    "refined_ratio": ("error,\nrefined", ".2f"),
    "nees_per_dof": ("NEES/3", ".2f"),
    "coverage_90": ("90 %\ncoverage", ".0%"),
    "time_ratio": ("time over\nreference", ".2f"),
}
FUSER_COLUMNS: dict[str, Column] = {
    "rank": ("rank", "d"),
    "fuser": ("fuser", ""),
    "landmark_rmse_m": ("landmarks\nm", ".4f"),
    "over_better_parent": ("over the\nbetter map", ".2f"),
    "nees_per_dof": ("NEES\nper dof", ".2f"),
    "coverage_95": ("95 %\ncoverage", ".1%"),
    "duplicate_share": ("duplicates", ".1%"),
    "time_ratio": ("time over\nreference", ".2f"),
}
_CHART_PX = 70, 34  # height of a chart: of its margins, and of each method


def print_leaderboard(board: Leaderboard, folder: Path) -> None:
    """Print both rankings, ties and the folder of the files."""
    rows = board.aligners
    n_mergeable = max(rows["n_mergeable"], default=0)
    note = f"equal ranks are ties; missed: of {n_mergeable} pairs of maps with {MERGEABLE_PAIRS} "
    note += f"or more true pairs; errors: medians on maps with {RICH_PAIRS} or more; time: over "
    note += f"{REFERENCE_ALIGNER}'s on the same maps"
    print_frame(rows, ALIGNER_COLUMNS, "Aligners", note)
    note = f"medians over runs; time: over {REFERENCE_FUSER}'s on the same maps"
    print_frame(board.fusers, FUSER_COLUMNS, "Fusers", note)
    given = board.alignments
    absent = dict.fromkeys(given.loc[given["status"] == Status.ABSENT, "aligner"])
    print_lines(f"  {name}: not ranked, it is not installed" for name in absent)
    failed = zip(rows["aligner"], rows["n_failed"], strict=True)
    print_lines(f"  {name}: failed on {n} tasks, see alignments.parquet" for name, n in failed if n)
    runs = board.tasks.tasks[["scenario", "seed"]].drop_duplicates()
    print_lines(f"  {line}" for line in few_runs_lines(len(runs)))
    print_lines([f"Page and tables: {folder}"])


def few_runs_lines(n_runs: int) -> list[str]:
    """Say that few runs cannot rank methods."""
    if n_runs >= RUNS_TO_RANK:
        return []
    few = f"{n_runs} runs can hardly tell methods apart: a method of rank 1 may still be wrong"
    return [f"{few}; rank on {RUNS_TO_RANK} runs or more (the usual set has 60)"]


def write_leaderboard(board: Leaderboard, folder: Path) -> None:
    """Write the tables, `leaderboard.html` and the provenance."""
    tables = {
        "alignments": (ALIGNMENTS, board.alignments),
        "fusions": (FUSIONS, board.fusions),
        "aligners": (ALIGNER_RANKS, board.aligners),
        "fusers": (FUSER_RANKS, board.fusers),
    }
    for name, (schema, rows) in tables.items():
        write_rows(folder / f"{name}.parquet", schema, rows)
    for name in ("aligners", "fusers"):
        write_text(folder / f"{name}.csv", tables[name][1].to_csv(index=False))
    tasks = board.tasks
    write_provenance(
        folder,
        {
            "task_set": {"version": tasks.card["version"], "sha256": tasks.digest},
            "made_by": tasks.card["softwareVersions"],
            "methods": dict(board.origins),
        },
    )
    contents = {
        "title": "Leaderboard",
        "command": "study leaderboard",
        "aligners": _text_rows(board.aligners, ALIGNER_COLUMNS),
        "aligner_headings": _headings(ALIGNER_COLUMNS),
        "fusers": _text_rows(board.fusers, FUSER_COLUMNS),
        "fuser_headings": _headings(FUSER_COLUMNS),
        "few_runs": few_runs_lines(len(tasks.tasks[["scenario", "seed"]].drop_duplicates())),
        "best": list(board.aligners.loc[board.aligners["rank"] == 1, "aligner"]),
        "n_tasks": len(tasks.tasks),
        "n_runs": len(tasks.tasks[["scenario", "seed"]].drop_duplicates()),
        "mergeable_pairs": MERGEABLE_PAIRS,
        "rich_pairs": RICH_PAIRS,
        "reference_aligner": REFERENCE_ALIGNER,
        "reference_fuser": REFERENCE_FUSER,
        "provenance": {
            "Task set": f"version {tasks.card['version']}",
            "SHA-256": tasks.digest,
            "Tasks": str(tasks.card["description"]),
        },
        "charts": {"ranks": _interval_figure(board.aligners)},
    }
    write_page(folder / "leaderboard.html", "leaderboard.html.j2", contents, [NEUTRAL])


def _headings(shown: Mapping[str, Column]) -> list[tuple[str, bool]]:
    """Return the headings of columns, and whether they hold numbers."""
    return [(heading.replace("\n", " "), bool(layout)) for heading, layout in shown.values()]


def _text_rows(frame: pd.DataFrame, shown: Mapping[str, Column]) -> list[list[str]]:
    """Return the cells of a table as text, with intervals where they are known."""
    rows = []
    for row in frame.to_dict("records"):
        cells = []
        for name, (_, layout) in shown.items():
            if f"{name}_low" in row:
                ends = (row[name], row[f"{name}_low"], row[f"{name}_high"])
                cells.append(interval(*ends, layout=layout))
            else:
                cells.append(number(row[name], layout) if layout else str(row[name]))
        rows.append(cells)
    return rows


def _interval_figure(aligners: pd.DataFrame) -> go.Figure | None:
    """Draw right decisions and errors over the oracle's of all aligners, with intervals."""
    if aligners.empty:
        return None
    figure = make_subplots(1, 2, shared_yaxes=True, horizontal_spacing=0.04)
    names = [escaped(name) for name in aligners["aligner"]]
    panels = (("decisions", "right decisions, %", 100), ("estimated_ratio", "error / oracle's", 1))
    for panel, (column, label, scale) in enumerate(panels, start=1):
        value, low, high = (
            scale * aligners[f"{column}{end}"].to_numpy(np.float64) for end in ("", "_low", "_high")
        )
        error = {"type": "data", "array": rounded(high - value), "symmetric": False, "width": 0}
        error |= {"arrayminus": rounded(value - low), "color": faint(NEUTRAL, 0.6)}
        trace = go.Scatter(
            x=rounded(value),
            y=names,
            mode="markers",
            marker={"size": 9, "color": NEUTRAL},
            error_x=error,
            showlegend=False,
            hovertemplate=f"%{{y}}: %{{x}}<extra>{label}</extra>",
        )
        figure.add_trace(trace, 1, panel)
        figure.update_xaxes(title_text=label, col=panel)
    figure.update_xaxes(type="log", col=2)
    figure.update_yaxes(autorange="reversed")
    margins, each = _CHART_PX
    return figure.update_layout(height=margins + each * len(names), hovermode="closest")
