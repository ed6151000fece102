"""What a benchmark leaves behind: tables for machines and people, and its figure."""

import math
import platform
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from experiments.judge.criteria import RIGHT_WITHIN_M, RIGHT_WITHIN_RAD
from experiments.methods.catalogue import find_method
from experiments.run.code_version import library_versions
from experiments.run.frames import write_rows
from experiments.show.export import to_markdown, write_text
from experiments.show.figures import style
from experiments.show.figures.drawing import save_figure
from experiments.study.benchmark.cells import SUMMARY, BenchmarkDesign
from experiments.study.benchmark.synthetic_pairs import SIGMA_M, SIZE_M
from experiments.study.benchmark.trials import TRIALS
from mapfusion.align.result import Status
from mapfusion.storage import write_json

SCHEMA_VERSION = 1
_BAND_ALPHA = 0.14
_DODGE = 0.45  # of the distance between two shares, over which the methods are spread
_MIN_SUCCESSES = 10  # the median error of fewer says little
_RATIO_TICKS = (1, 2, 5, 10, 20, 50, 100)
_RATIO_RANGE = (0.9, 11.0)  # shown at least
_MARGIN = 1.15  # about what is drawn
_ROWS = ("success (%)", "error over the oracle's", "time of one call (ms)")


def write_benchmark(
    folder: Path, design: BenchmarkDesign, trials: pd.DataFrame, summary: pd.DataFrame
) -> None:
    """Write `trials`, `summary` (Parquet and CSV), `summary.md`, `benchmark.*` and provenance."""
    write_rows(folder / "trials.parquet", TRIALS, trials)
    write_rows(folder / "summary.parquet", SUMMARY, summary)
    write_text(folder / "summary.csv", summary.to_csv(index=False))
    write_text(folder / "summary.md", markdown(design, summary))
    provenance = {
        "schema_version": SCHEMA_VERSION,
        "seed": design.seed,
        "trials": design.trials,
        "budget_s": design.budget_s,
        "aligners": [
            entry.model_dump(mode="json") | {"origin": find_method(entry.method).origin()}
            for entry in design.aligners
        ],
        "python": platform.python_version(),
        "machine": platform.machine(),
        "libraries": library_versions(),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    write_json(folder / "provenance.json", provenance)
    save_figure(folder, "benchmark", draw, summary)


def markdown(design: BenchmarkDesign, summary: pd.DataFrame) -> str:
    """The whole table for people: one section for each number of pairs."""
    parts = [
        f"# Aligners on made-up maps\n\n"
        f"Planar maps of landmarks uniform in {SIZE_M:g} x {SIZE_M:g} m, residuals of true pairs "
        f"{SIGMA_M:g} m per axis, false pairs uniform; {design.trials} trials a cell, seed "
        f"{design.seed}, the same maps for all methods.\n\n"
        f"Each cell: successes in % (accepted and within {RIGHT_WITHIN_M:g} m and "
        f"{RIGHT_WITHIN_RAD:g} rad as estimated) with Wilson's 95 % interval; the median "
        "translation error of the successes over the oracle's (least squares on the true pairs) on "
        "the same maps, as estimated / after the common least squares; the median time of one "
        "call, serial and warmed. `wrong` counts, where there are any, trials accepted though "
        "outside the tolerance. Below 3 true pairs no motion is determined: there the right answer "
        "is a refusal.\n"
    ]
    for n_pairs, rows in summary.groupby("n_pairs", sort=False):
        columns = {
            f"{share:.0%} outliers ({cells['n_true'].iloc[0]} true)": cells.set_index(
                "method"
            ).apply(cell_text, axis=1)
            for share, cells in rows.groupby("outlier_share", sort=False)
        }
        table = pd.DataFrame(columns).reset_index(names="method")
        parts += [f"## {n_pairs} pairs\n", to_markdown(table)]
    return "\n".join(parts)


def cell_text(cell: pd.Series) -> str:
    """One cell in words: success, error over the oracle, time."""
    if cell["status"] == Status.ABSENT:
        return "absent"
    low, high = (f"{100 * cell[name]:.0f}" for name in ("success_low", "success_high"))
    parts = [f"**{100 * cell['success']:.0f}** ({low}-{high})"]
    if cell["n_success"]:
        ratios = (cell["ratio_m"], cell["refined_ratio_m"])
        parts.append(" / ".join("-" if math.isnan(r) else f"{r:.2f}" for r in ratios))
    if not math.isnan(cell["elapsed_s"]):
        elapsed_ms = 1e3 * cell["elapsed_s"]
        parts.append(f"{elapsed_ms:.0f} ms" if elapsed_ms >= 100 else f"{elapsed_ms:.3g} ms")
    parts += [f"{cell[f'n_{what}']} {what}" for what in ("wrong", "failed") if cell[f"n_{what}"]]
    return ", ".join(parts)


def draw(summary: pd.DataFrame) -> Figure:
    """One column of panels for each number of pairs; the rows as in `_ROWS`.

    Bands: Wilson's 95 % interval of the success, 10-90 % of the trials' times. The shares are
    spaced evenly and the methods set a little apart, as most lie on one another.
    """
    counts = summary["n_pairs"].unique()
    methods = summary["method"].unique().tolist()
    styles = style.aligner_styles(methods)
    shares = sorted(summary["outlier_share"].unique())
    figure = Figure(figsize=(style.PAGE_WIDTH_IN, 6.6))
    panels = figure.subplots(len(_ROWS), len(counts), sharex=True, sharey="row", squeeze=False)
    ran = summary[summary["status"] != Status.ABSENT].sort_values("outlier_share")
    for column, count in zip(panels.T, counts, strict=True):
        for place, method in enumerate(methods):
            own = ran[(ran["n_pairs"] == count) & (ran["method"] == method)]
            offset = _DODGE * ((place + 0.5) / len(methods) - 0.5)
            x = np.searchsorted(shares, own["outlier_share"]) + offset
            _add_method(column, x, own, styles[method])
        column[0].set_title(f"{count} pairs")
        column[-1].set_xlabel("outliers (%)")
    _lay_out(panels, shares)
    absent = set(summary["method"][summary["status"] == Status.ABSENT])
    looks = {f"{m} (absent)" if m in absent else m: styles[m] for m in methods}
    style.aligner_legend(figure, looks, columns=5)
    return figure


def _add_method(axes: np.ndarray, x: np.ndarray, own: pd.DataFrame, line: dict) -> None:
    success, ratio, elapsed = axes
    line = line | {"linewidth": 0.8, "markersize": 2.8}
    ends = (100 * own["success_low"], 100 * own["success_high"])
    success.vlines(x, *ends, color=line["color"], linewidth=2.2, alpha=0.35)
    success.plot(x, 100 * own["success"], **line)
    ratio.plot(x, own["ratio_m"].where(own["n_success"] >= _MIN_SUCCESSES), **line)
    ends = (1e3 * own["elapsed_low_s"], 1e3 * own["elapsed_high_s"])
    elapsed.fill_between(x, *ends, color=line["color"], alpha=_BAND_ALPHA, linewidth=0)
    elapsed.plot(x, 1e3 * own["elapsed_s"], **line)


def _lay_out(panels: np.ndarray, shares: list[float]) -> None:
    axes: Axes
    for row, label in zip(panels, _ROWS, strict=True):
        row[0].set_ylabel(label)
        for axes in row:
            axes.set_xticks(range(len(shares)), [f"{100 * share:g}" for share in shares])
            axes.grid(visible=False, axis="x")
    panels[0, 0].set_ylim(-3, 103)
    for axes in panels[1:].flat:
        axes.set_yscale("log")
        style.write_plainly(axes.yaxis)
    drawn = [line.get_ydata() for axes in panels[1] for line in axes.get_lines()]
    ratios = np.concatenate([*drawn, _RATIO_RANGE])
    panels[1, 0].set_yticks(_RATIO_TICKS)
    panels[1, 0].set_ylim(np.nanmin(ratios) / _MARGIN, np.nanmax(ratios) * _MARGIN)
    panels[1, 0].yaxis.set_minor_locator(NullLocator())
