"""What `run` and `check` show."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
from rich.console import Console
from rich.table import Table

from experiments.judge import tables
from experiments.judge.metrics import ORACLE
from experiments.show.terminal.layout import LAYOUT, number, print_skipped
from mapfusion.align.result import NOT_RUN, Status

if TYPE_CHECKING:
    from experiments.judge.expectations import Outcome

_SEEDS_SHOWN = 3  # one by one, in a table of checks
MIN_TRUE_PAIRS_SHOWN = 3  # as figures 4 and 5 shade: fewer cannot carry an alignment


def print_result(result: Path, skipped_figures: Sequence[str]) -> None:
    """The table of all aligners, and where everything is."""
    errors = tables.read(tables.table_path(result, "errors"), "errors")
    timings = tables.read(tables.table_path(result, "aligner_timings"), "aligner_timings")
    console = Console()
    console.print(_aligner_table(errors, timings, _aligner_order(result)))
    for line in not_run_lines(errors):
        console.print(f"  {line}", soft_wrap=True, markup=False)
    console.print(_pair_table(errors, _aligner_order(result)[0]))
    robots = tables.read(tables.table_path(result, "robots"), "robots")
    console.print(_robot_table(robots))
    for line in _left_out(result, robots["robot"].iloc[0]):
        console.print(line, soft_wrap=True, markup=False)
    console.print(f"Figures: {result / 'figures'}   tables: {result / 'tables'}", soft_wrap=True)
    print_skipped(console, skipped_figures)


def _aligner_order(result: Path) -> list[str]:
    scenario = json.loads((result / "scenario.json").read_text(encoding="utf-8"))
    return [entry["name"] for entry in scenario["align"]["aligners"]] + [ORACLE]


def _left_out(result: Path, first: str) -> list[str]:
    """Which maps are not in the fused one, and why."""
    scenario = json.loads((result / "scenario.json").read_text(encoding="utf-8"))
    estimates = tables.read(tables.table_path(result, "estimates"), "estimates")
    used = estimates[
        (estimates["aligner"] == scenario["merge"]["aligner"])
        & (estimates["repetition"] == 0)
        & (estimates["robot_a"] == first)
    ]
    last = used[used["iteration"] == used.groupby("robot_b")["iteration"].transform("max")]
    return [
        f"  {row['robot_b']} is left out of the fused map: {row['acceptance_reason']}"
        for row in last[~last["accepted"]].to_dict("records")
    ]


def aligner_summary(errors: pd.DataFrame, timings: pd.DataFrame, order: list[str]) -> pd.DataFrame:
    """One row an aligner: medians over the iterations with three or more true pairs."""
    used = errors[errors["n_true"] >= MIN_TRUE_PAIRS_SHOWN]
    used = used[used["status"] != Status.ABSENT]  # neither accepted nor not
    rows = []
    for aligner in order:
        own = used[used["aligner"] == aligner]
        spread = own.groupby(["robot_a", "robot_b", "iteration"])["translation_error_m"]
        time_s = timings[timings["aligner"] == aligner]["elapsed_s"]
        rows.append(
            {
                "aligner": aligner,
                "estimated_m": own["translation_error_m"].median(),
                "estimated_rad": own["rotation_error_rad"].abs().median(),
                "spread_m": (spread.quantile(0.9) - spread.quantile(0.1)).median(),
                "refined_m": own["refined_translation_error_m"].median(),
                "refined_rad": own["refined_rotation_error_rad"].abs().median(),
                "accepted": own["accepted"].mean(),
                "time_ms": 1e3 * time_s.median() if len(time_s) else math.nan,
            }
        )
    return pd.DataFrame(rows)


def not_run_lines(errors: pd.DataFrame) -> list[str]:
    """One line for each aligner, and each reason, that did not run."""
    not_run = errors[errors["status"].isin(NOT_RUN)]
    n_rows = errors.groupby("aligner").size().to_dict()
    lines = []
    for (aligner, status, reason), rows in not_run.groupby(
        ["aligner", "status", "reason"], sort=False
    ):
        share = "" if status == Status.ABSENT else f" in {len(rows)} of {n_rows[aligner]} rows"
        lines.append(f"{aligner}: {status}{share}: {reason}")
    return lines


def _aligner_table(errors: pd.DataFrame, timings: pd.DataFrame, order: list[str]) -> Table:
    columns = {
        "estimated_m": ("estim.\nm", ".3f"),
        "estimated_rad": ("\nrad", ".4f"),
        "spread_m": ("spread\nm", ".3f"),
        "refined_m": ("refined\nm", ".3f"),
        "refined_rad": ("\nrad", ".4f"),
        "accepted": ("ok\n", ".0%"),
        "time_ms": ("time\nms", ".2f"),
    }
    maps = errors[errors["n_true"] >= MIN_TRUE_PAIRS_SHOWN]
    n_offered = maps["n_correspondences"].median()
    share = (maps["n_true"] / maps["n_correspondences"]).median()
    offered = f"\npairs offered: {n_offered:.0f}, {share:.0%} of them true" if len(maps) else ""
    table = Table(
        title=f"Alignment errors: medians over iterations with {MIN_TRUE_PAIRS_SHOWN}+ true pairs",
        caption="spread: 10-90 % of the repetitions; ok: accepted as more than chance" + offered,
        **LAYOUT,
    )
    table.add_column("\naligner", no_wrap=True)
    for heading, _ in columns.values():
        table.add_column(heading, justify="right", no_wrap=True)
    for row in aligner_summary(errors, timings, order).to_dict("records"):
        cells = [number(row[name], layout) for name, (_, layout) in columns.items()]
        table.add_row(str(row["aligner"]), *cells)
    return table


def _pair_table(errors: pd.DataFrame, aligner: str) -> Table:
    """Each pair at its last iteration: the first aligner, refined, beside the oracle."""
    table = Table(title=f"Pairs at the last iteration, {aligner} refined", **LAYOUT)
    for heading in ("pair", "error, m", "error, rad", "oracle, m", "oracle, rad", "true pairs"):
        table.add_column(heading, justify="left" if heading == "pair" else "right")
    for (a, b), rows in errors.groupby(["robot_a", "robot_b"]):
        last = rows[rows["iteration"] == rows["iteration"].max()]
        cells = []
        for name in (aligner, ORACLE):
            own = last[last["aligner"] == name]
            cells.append(number(own["refined_translation_error_m"].median(), ".3f"))
            cells.append(number(own["refined_rotation_error_rad"].median(), "+.4f"))
        n_true = f"{last['n_true'].iloc[0]} of {last['n_correspondences'].iloc[0]}"
        table.add_row(f"{a} - {b}", *cells, n_true)
    return table


def _robot_table(robots: pd.DataFrame) -> Table:
    table = Table(title="Position errors (RMS)", **LAYOUT)
    for heading in ("robot", "FastSLAM, m", "odometry, m", "ratio", "landmarks"):
        table.add_column(heading, justify="left" if heading == "robot" else "right")
    for name, rows in robots.groupby("robot"):
        path, odometry = ((rows[f"{x}_error_m"] ** 2).mean() ** 0.5 for x in ("path", "odometry"))
        landmarks = rows["n_landmarks"].iloc[-1]
        ratio = path / odometry if odometry else math.nan
        table.add_row(
            str(name), f"{path:.3f}", f"{odometry:.3f}", number(ratio, ".2f"), str(landmarks)
        )
    return table


def print_outcomes(outcomes: Sequence["Outcome"]) -> None:
    """The table of a check."""
    table = Table(title="Checks against the truth", **LAYOUT)
    for heading in ("scenario", "metric", "measured", "expected", "by seed", ""):
        side = "right" if heading == "measured" else "left"
        table.add_column(heading, justify=side, overflow="fold", no_wrap=heading == "expected")
    for outcome in outcomes:
        seeds = _by_seed(list(outcome.per_seed.values()))
        verdict = "[green]pass[/]" if outcome.passed else "[bold red]FAIL[/]"
        table.add_row(
            outcome.scenario,
            outcome.metric,
            f"{outcome.value:.4g}",
            outcome.bound_text,
            seeds,
            verdict,
        )
    console = Console()
    console.print(table)
    failed = sum(not outcome.passed for outcome in outcomes)
    console.print(f"{len(outcomes) - failed} passed, {failed} failed")


def _by_seed(values: Sequence[float]) -> str:
    """Each seed's value; of more than a line holds the smallest and the largest."""
    if len(values) <= _SEEDS_SHOWN:
        return "  ".join(f"{value:.3g}" for value in values)
    return f"{min(values):.3g} to {max(values):.3g}"
