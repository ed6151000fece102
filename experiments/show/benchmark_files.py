"""What a benchmark leaves behind: tables for machines and people, and its figure."""

import json
import math
import platform
from datetime import UTC, datetime
from pathlib import Path

import pandas as pd

from experiments.judge.criteria import RIGHT_WITHIN_M, RIGHT_WITHIN_RAD
from experiments.methods.catalogue import find_method
from experiments.run.code_version import library_versions
from experiments.run.frames import write_rows
from experiments.show.export import to_markdown
from experiments.show.figures.benchmark_figure import draw
from experiments.show.figures.drawing import save_figure
from experiments.show.figures.style import house_style
from experiments.study.benchmark.cells import SUMMARY, BenchmarkDesign
from experiments.study.benchmark.synthetic_pairs import SIGMA_M, SIZE_M
from experiments.study.benchmark.trials import TRIALS
from mapfusion.align.result import Status
from mapfusion.storage import write_whole

SCHEMA_VERSION = 1


def write_benchmark(
    folder: Path, design: BenchmarkDesign, trials: pd.DataFrame, summary: pd.DataFrame
) -> None:
    """Write `trials`, `summary` (Parquet and CSV), `summary.md`, `benchmark.*` and provenance."""
    write_rows(folder / "trials.parquet", TRIALS, trials)
    write_rows(folder / "summary.parquet", SUMMARY, summary)
    for name, text in (
        ("summary.csv", summary.to_csv(index=False)),
        ("summary.md", markdown(design, summary)),
        ("provenance.json", json.dumps(_provenance(design), indent=1)),
    ):
        write_whole(folder / name, lambda path, text=text: path.write_text(text, encoding="utf-8"))
    with house_style():
        save_figure(draw(summary), folder, "benchmark")


def _provenance(design: BenchmarkDesign) -> dict[str, object]:
    return {
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
        parts += [f"## {n_pairs} pairs\n", _section(rows)]
    return "\n".join(parts)


def _section(rows: pd.DataFrame) -> str:
    columns = {
        f"{share:.0%} outliers ({cells['n_true'].iloc[0]} true)": cells.set_index("method").apply(
            cell_text, axis=1
        )
        for share, cells in rows.groupby("outlier_share", sort=False)
    }
    return to_markdown(pd.DataFrame(columns).reset_index(names="method"))


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
