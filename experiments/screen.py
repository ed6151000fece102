"""What the commands show: progress, tables, where files are."""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from experiments import tables
from experiments.metrics import ORACLE
from mapfusion.align.registry import known_methods, name_clashes
from mapfusion.align.result import NOT_RUN, Status

if TYPE_CHECKING:
    from experiments.checks import Outcome
    from experiments.suite import Entry
    from mapfusion.landmark_map import LandmarkMap
    from mapfusion.merge import FusedMap

MIN_TRUE_PAIRS_SHOWN = 3  # as figures 4 and 5 shade: fewer cannot carry an alignment

# Plain rules and narrow gaps: all columns must fit into 80 characters.
_LAYOUT: Any = {
    "box": box.SIMPLE_HEAD,
    "padding": (0, 1, 0, 0),
    "title_style": "bold",
    "title_justify": "left",
    "caption_justify": "left",
}

STAGE_TEXT = {
    "drive": "drive the robots",
    "faces": "paint the walls",
    "render": "render and find features",
    "log": "track features",
    "slam": "FastSLAM",
    "align": "align the maps",
    "judge": "compare with the truth",
    "tables": "write the tables",
    "figures": "draw the figures",
    "benchmark": "measure the aligners",
    "refusal": "cross the worlds",
}


@contextmanager
def progress() -> Iterator[Callable[[str, int, int], None]]:
    """A progress display on stderr; yields the function to tell (stage, done, total)."""
    display = Progress(
        TextColumn("{task.description:<26}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
    )
    bars: dict[str, Any] = {}
    with display:

        def show(stage: str, done: int, total: int) -> None:
            if stage not in bars or (done == 0 and bars[stage][1]):
                bars[stage] = [display.add_task(STAGE_TEXT.get(stage, stage), total=total), False]
            bar, _ = bars[stage]
            display.update(bar, completed=done, total=total)
            bars[stage][1] = done == total

        yield show


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
    _print_skipped(console, skipped_figures)


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
        **_LAYOUT,
    )
    table.add_column("\naligner", no_wrap=True)
    for heading, _ in columns.values():
        table.add_column(heading, justify="right", no_wrap=True)
    for row in aligner_summary(errors, timings, order).to_dict("records"):
        cells = [_number(row[name], layout) for name, (_, layout) in columns.items()]
        table.add_row(str(row["aligner"]), *cells)
    return table


def _number(value: float, layout: str) -> str:
    return "-" if math.isnan(value) else format(value, layout)


def _pair_table(errors: pd.DataFrame, aligner: str) -> Table:
    """Each pair at its last iteration: the first aligner, refined, beside the oracle."""
    table = Table(title=f"Pairs at the last iteration, {aligner} refined", **_LAYOUT)
    for heading in ("pair", "error, m", "error, rad", "oracle, m", "oracle, rad", "true pairs"):
        table.add_column(heading, justify="left" if heading == "pair" else "right")
    for (a, b), rows in errors.groupby(["robot_a", "robot_b"]):
        last = rows[rows["iteration"] == rows["iteration"].max()]
        cells = []
        for name in (aligner, ORACLE):
            own = last[last["aligner"] == name]
            cells.append(_number(own["refined_translation_error_m"].median(), ".3f"))
            cells.append(_number(own["refined_rotation_error_rad"].median(), "+.4f"))
        n_true = f"{last['n_true'].iloc[0]} of {last['n_correspondences'].iloc[0]}"
        table.add_row(f"{a} - {b}", *cells, n_true)
    return table


def _robot_table(robots: pd.DataFrame) -> Table:
    table = Table(title="Position errors (RMS)", **_LAYOUT)
    for heading in ("robot", "FastSLAM, m", "odometry, m", "ratio", "landmarks"):
        table.add_column(heading, justify="left" if heading == "robot" else "right")
    for name, rows in robots.groupby("robot"):
        path, odometry = ((rows[f"{x}_error_m"] ** 2).mean() ** 0.5 for x in ("path", "odometry"))
        landmarks = rows["n_landmarks"].iloc[-1]
        ratio = path / odometry if odometry else math.nan
        table.add_row(
            str(name), f"{path:.3f}", f"{odometry:.3f}", _number(ratio, ".2f"), str(landmarks)
        )
    return table


def print_outcomes(outcomes: Sequence["Outcome"]) -> None:
    """The table of a check."""
    table = Table(title="Checks against the truth", **_LAYOUT)
    for heading in ("scenario", "metric", "measured", "expected", "by seed", ""):
        table.add_column(heading, justify="right" if heading == "measured" else "left")
    for outcome in outcomes:
        seeds = "  ".join(f"{value:.3g}" for value in outcome.per_seed.values())
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


def print_refusals(rows: Sequence[dict[str, Any]], false_alarms: float) -> None:
    """False and missed merges of each aligner (rows of `experiments.refusal.summary`)."""
    headings = {
        "false": "false\nmerges",
        "wrong": "wrong\n",
        "missed": "missed\nof all",
        "missed_though_right": "\nof right",
        "few_missed_though_right": "20 true:\nmissed",
        "few_wrong": "\nwrong",
    }
    table = Table(
        title=f"Accepted where chance gives at most {false_alarms:g} a pair of maps",
        caption="false: accepted without common ground; wrong: accepted with some,\n"
        "0.5 m or 0.1 rad off; missed: refused with 20 or more true pairs, of\n"
        "all and of those right; 20 true: just 20 in one corner are left",
        **_LAYOUT,
    )
    table.add_column("\naligner", no_wrap=True)
    for heading in headings.values():
        table.add_column(heading, justify="right", no_wrap=True)
    posters = Table(title="Accepted: one picture in two worlds", **_LAYOUT)
    posters.add_column("aligner", no_wrap=True)
    radii = [name for name in rows[0] if name.startswith("poster_")]
    for name in radii:
        posters.add_column(f"{2 * float(name.removeprefix('poster_')):g} m wide", justify="right")
    for row in rows:
        table.add_row(row["aligner"], *(_of_all(row[name]) for name in headings))
        posters.add_row(row["aligner"], *(_of_all(row[name]) for name in radii))
    console = Console()
    console.print(table)
    console.print(posters)


def _of_all(rate: Any) -> str:
    return f"{rate.hits}/{rate.n}"


def print_paths(folder: Path, paths: Sequence[Path], skipped: Sequence[str] = ()) -> None:
    """Where files were written."""
    console = Console()
    console.print(f"{len(paths)} written to {folder}", soft_wrap=True)
    _print_skipped(console, skipped)


def print_file(path: Path) -> None:
    """Where a file was written, and how large it is."""
    Console().print(f"{path} ({path.stat().st_size / 1e6:.1f} MB)", soft_wrap=True, markup=False)


def _print_skipped(console: Console, skipped: Sequence[str]) -> None:
    for line in skipped:
        console.print(f"  not drawn: {line}", soft_wrap=True)


def print_map(path: Path, landmarks: "LandmarkMap") -> None:
    """What a map holds and where it is."""
    Console().print(f"{len(landmarks)} landmarks of {landmarks.name} in {path}", soft_wrap=True)


def print_estimates(rows: Sequence[dict[str, Any]]) -> None:
    """Estimates of all aligners on two maps, and why those were not accepted that were not."""
    table = Table(
        title="T_a_b, as estimated and refined",
        caption="NFA: expected number of alignments that chance alone supports as well",
        **_LAYOUT,
    )
    headings = ["\naligner", "tx\nm", "ty\nm", "theta\nrad"]
    headings += ["refined\nm", "ty\nm", "theta\nrad", "\ninliers", "NFA\nlog10", "time\nms"]
    for heading in headings:
        table.add_column(heading, justify="left" if "aligner" in heading else "right", no_wrap=True)
    for row in rows:
        table.add_row(
            row["aligner"],
            *(_number(row[name], ".2f") for name in ("tx_m", "ty_m", "theta_rad")),
            *(_number(row[f"refined_{name}"], ".2f") for name in ("tx_m", "ty_m")),
            _number(row["refined_theta_rad"], ".3f"),
            f"{row['n_inliers']}/{row['n_correspondences']}",
            _number(row["log10_false_alarms"], ".0f"),
            f"{1e3 * row['elapsed_s']:.1f}",
        )
    console = Console()
    console.print(table)
    for row in rows:
        reason = row["reason"] or row["acceptance_reason"]
        if reason:
            refused = row["status"] if row["status"] in NOT_RUN else Status.REFUSED
            status = Status.ACCEPTED if row["accepted"] else refused
            console.print(f"  {row['aligner']}: {status}: {reason}", soft_wrap=True, markup=False)


def print_benchmark(folder: Path, summary: pd.DataFrame) -> None:
    """Successes and times for each number of pairs, and where the rest is."""
    console = Console()
    for n_pairs, rows in summary.groupby("n_pairs", sort=False):
        table = Table(title=f"{n_pairs} pairs: success in %, time in ms", **_LAYOUT)
        table.add_column("outliers", no_wrap=True)
        for share in rows["outlier_share"].drop_duplicates():
            table.add_column(f"{100 * share:g} %", justify="right", no_wrap=True)
        for method, own in rows.groupby("method", sort=False):
            cells = [
                "absent"
                if row["status"] == Status.ABSENT
                else f"{100 * row['success']:.0f}, {_milliseconds(row['elapsed_s'])}"
                for row in own.to_dict("records")
            ]
            table.add_row(escape(str(method)), *cells)
        console.print(table)
    failed = summary[summary["n_failed"] > 0]
    for method, rows in failed.groupby("method", sort=False):
        text = f"  {method}: failed in {rows['n_failed'].sum()} trials, see trials.parquet"
        console.print(text, soft_wrap=True, markup=False)
    console.print(f"Table and figure: {folder}", soft_wrap=True)


def _milliseconds(elapsed_s: float) -> str:
    """Two digits or all before the point: 0.23, 4.6, 31, 1710."""
    elapsed_ms = 1e3 * elapsed_s
    return _number(elapsed_ms, ".0f" if elapsed_ms >= 10 else ".2g")


def print_methods() -> None:
    """Every alignment method by name, whose it is, and what is wrong where something is."""
    table = Table(title="Alignment methods", **_LAYOUT)
    for heading in ("method", "whose", "package", "version"):
        table.add_column(heading)
    methods = known_methods().values()
    for method in methods:
        version = "absent" if method.absence else method.version
        cells = (method.name, method.kind, method.distribution, version)
        table.add_row(*(escape(cell) for cell in cells))
    console = Console()
    console.print(table)
    lines = [f"{method.name}: {method.absence}" for method in methods if method.absence]
    for line in [*lines, *name_clashes().values()]:
        console.print(f"  {line}", soft_wrap=True, markup=False)


def print_fused(path: Path, fused: "FusedMap", names: Sequence[str]) -> None:
    """What a fused map was made of."""
    console = Console()
    several = int(((fused.parents >= 0).sum(axis=1) > 1).sum())
    console.print(
        f"{len(fused.landmarks)} landmarks in {path}, {several} of them fused from several maps; "
        f"{fused.duplicate_share:.1%} look like duplicates that remain",
        soft_wrap=True,
    )
    for name, motion in zip(names, fused.T_first_map, strict=True):
        if not math.isnan(motion[0]):
            text = f"({motion[0]:.3f} m, {motion[1]:.3f} m, {motion[2]:.4f} rad)"
            console.print(f"  {name}: T_first_map = {text}")
    for name, reason in fused.left_out:
        console.print(f"  {name}: left out, its alignment was not accepted ({reason})")


def print_scenarios(entries: "Sequence[Entry]") -> None:
    """The scenarios of a folder."""
    table = Table(**_LAYOUT)
    for title in ("scenario", "tags"):
        table.add_column(title, overflow="fold")
    for title in ("robots", "iterations", "overlap"):
        table.add_column(title, justify="right")
    table.add_column("what it is", ratio=1)
    for entry in entries:
        table.add_row(
            escape(entry.name),
            escape(" ".join(entry.tags)),
            str(entry.robots),
            "recorded" if entry.iterations is None else str(entry.iterations),
            "" if entry.overlap is None else f"{entry.overlap:.2f}",
            escape(entry.description),
        )
    Console().print(table)
