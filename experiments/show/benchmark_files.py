"""What a benchmark leaves behind: tables for machines and people, and its figure."""

import json
import math
import platform
from datetime import UTC, datetime
from pathlib import Path

import pandas as pd

from experiments.methods.catalogue import find_method
from experiments.run.code_version import library_versions
from experiments.show.figures.benchmark_figure import draw
from experiments.show.figures.drawing import save_figure
from experiments.show.figures.style import house_style
from experiments.study.benchmark.synthetic_pairs import SIGMA_M, SIZE_M
from experiments.study.benchmark.trials import SUMMARY, TOLERANCE_M, TOLERANCE_RAD, TRIALS, Plan
from mapfusion.align.result import Status
from mapfusion.storage import write_table, write_whole

SCHEMA_VERSION = 1
_ABSENT = "absent"
_MIN_TRUE_PAIRS = 3  # below, no motion is determined


def write_benchmark(folder: Path, plan: Plan, trials: pd.DataFrame, summary: pd.DataFrame) -> None:
    """Write `trials`, `summary` (Parquet and CSV), `summary.md`, `benchmark.*` and provenance."""
    columns = {str(name): trials[name].to_numpy() for name in trials}
    write_table(folder / "trials.parquet", columns, TRIALS)
    columns = {str(name): summary[name].to_numpy() for name in summary}
    write_table(folder / "summary.parquet", columns, SUMMARY)
    write_whole(folder / "summary.csv", lambda path: summary.to_csv(path, index=False))
    text = markdown(plan, summary)
    write_whole(folder / "summary.md", lambda path: path.write_text(text, encoding="utf-8"))
    with house_style():
        save_figure(draw(summary), folder, "benchmark")
    described = json.dumps(_provenance(plan), indent=1)
    write_whole(folder / "provenance.json", lambda path: path.write_text(described, "utf-8"))


def _provenance(plan: Plan) -> dict[str, object]:
    return {
        "schema_version": SCHEMA_VERSION,
        "seed": plan.seed,
        "trials": plan.trials,
        "budget_s": plan.budget_s,
        "aligners": [
            entry.model_dump(mode="json") | {"origin": find_method(entry.method).origin()}
            for entry in plan.aligners
        ],
        "python": platform.python_version(),
        "machine": platform.machine(),
        "libraries": library_versions(),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def markdown(plan: Plan, summary: pd.DataFrame) -> str:
    """The whole table for people: one section for each number of pairs."""
    parts = [_preamble(plan)]
    for n_pairs, rows in summary.groupby("n_pairs", sort=False):
        parts += [f"## {n_pairs} pairs\n", _section(rows), ""]
    return "\n".join(parts)


def _preamble(plan: Plan) -> str:
    return (
        "# Aligners on made-up maps\n\n"
        f"Planar maps of landmarks uniform in {SIZE_M:g} x {SIZE_M:g} m, residuals of true pairs "
        f"{SIGMA_M:g} m per axis, false pairs uniform; {plan.trials} trials a cell, seed "
        f"{plan.seed}, the same maps for all methods.\n\n"
        f"Each cell: successes in % (accepted and within {TOLERANCE_M:g} m and "
        f"{TOLERANCE_RAD:g} rad as estimated) with Wilson's 95 % interval; the median translation "
        "error of the successes over the oracle's (least squares on the true pairs) on the same "
        "maps, as estimated / after the common least squares; the median time of one call, serial "
        "and warmed. "
        "`wrong` counts, where there are any, trials accepted though outside the tolerance. Below "
        f"{_MIN_TRUE_PAIRS} true pairs no motion is determined: there the right answer is a "
        "refusal.\n"
    )


def _section(rows: pd.DataFrame) -> str:
    shares = rows["outlier_share"].drop_duplicates().tolist()
    n_true = rows.groupby("outlier_share")["n_true"].first()
    headings = [f"{share:.0%} outliers ({n_true[share]} true)" for share in shares]
    table = [
        [method, *(cell_text(own[own["outlier_share"] == share].iloc[0]) for share in shares)]
        for method, own in rows.groupby("method", sort=False)
    ]
    frame = pd.DataFrame(table, columns=pd.Index(["method", *headings]))
    return frame.to_markdown(index=False, disable_numparse=True)


def cell_text(cell: pd.Series) -> str:
    """One cell in words: success, error over the oracle, time."""
    if cell["status"] == Status.ABSENT:
        return _ABSENT
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
