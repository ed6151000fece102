"""Screens of `study`, `sweep` and `calibrate`."""

import itertools
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from ruamel.yaml import YAML

from experiments.evaluation.alignment_criteria import (
    ANSWERABLE_PAIRS,
    MERGEABLE_PAIRS,
    RIGHT_WITHIN_M,
    RIGHT_WITHIN_RAD,
)
from experiments.evaluation.single_steps import filter_settings
from experiments.reports.layout import (
    NO_ESTIMATE,
    Column,
    columns,
    interval,
    print_frame,
    print_lines,
    print_skipped,
    print_table,
    two_digits,
)
from experiments.studies.independence_trial import COST_HEADINGS, STRATEGIES, shown_numbers
from experiments.studies.paper_claims import claims_table
from experiments.studies.refusal_rates import (
    VERDICTS,
    Guarantee,
    Rate,
    clean_runs_needed,
    pooled,
    worst,
)
from experiments.studies.sweep import Survey, SweepProgress
from experiments.studies.sweep_tables import (
    ERRORS,
    GIVEN,
    SweepDataset,
    SweepRun,
    medians_over_runs,
)
from mapfusion.align.alignment import Status
from mapfusion.smoother.noise_estimation import NOISE_PARAMETERS
from mapfusion.smoother.odometry_calibration import Calibration


def print_benchmark(folder: Path, summary: pd.DataFrame) -> None:
    """Print successes and times by number of correspondences, and the folder of the results."""

    def text(row: dict[Any, Any]) -> str:
        if row["status"] == Status.ABSENT:
            return "absent"
        return f"{100 * row['success']:.0f}, {two_digits(1e3 * row['elapsed_s'])}"

    for n_pairs, rows in summary.groupby("n_pairs", sort=False):
        shares = rows["outlier_share"].drop_duplicates()
        shown = [("outliers", ""), *((f"{100 * share:g} %", ">") for share in shares)]
        cells = [
            [method, *(text(row) for row in own.to_dict("records"))]
            for method, own in rows.groupby("method", sort=False)
        ]
        print_table(shown, cells, f"{n_pairs} correspondences: success in %, time in ms")
    failed = summary.groupby("method", sort=False)["n_failed"].sum()
    print_lines(
        f"  {method}: failed in {n} trials, see trials.parquet"
        for method, n in failed[failed > 0].items()
    )
    print_lines([f"Table and figure: {folder}"])


def print_independence(folder: Path, summary: pd.DataFrame, skipped: Sequence[str]) -> None:
    """Print costs and errors of each strategy (`medians_at_last_iteration`), and the folder."""
    headings = [("way", ""), *((heading, ">") for _, heading in COST_HEADINGS.values())]
    note = "; ".join(f"{strategy.name}: {strategy.label}" for strategy in STRATEGIES)
    for n_robots, rows in summary.groupby("n_robots"):
        numbers = (shown_numbers(rows, name).map(two_digits) for name in COST_HEADINGS)
        cells = zip(rows["strategy"], *numbers, strict=True)
        whole = f"{rows['n_whole'].min()} of {rows['n_seeds'].max()} runs"
        title = f"{n_robots} robots, at the end (one map of all in {whole})"
        print_table(headings, cells, title, note)
    print_lines([f"Tables and figure: {folder}"])
    print_skipped(skipped)


def print_claims(values: pd.DataFrame) -> None:
    """Print verdict and value of each claim of the paper, a column per scenario and renderer."""
    table = claims_table(values).drop(columns=["measure", "why"])
    shown = table.map(lambda text: str(text).replace("**", ""))
    headings = [(str(name), "") for name in shown.columns]
    print_table(headings, shown.to_numpy().tolist(), "The paper beside this software")


MAX_ROWS_SHOWN = 60
MAX_FAILURES_SHOWN = 10


def shown_by(show: Callable[[str, int, int], None]) -> Callable[[SweepProgress], None]:
    """Return a function that shows one progress bar of runs and one of each stage."""

    def show_sweep(now: SweepProgress) -> None:
        show("runs", now.done, now.runs)
        if now.failed:
            show("runs that failed", len(now.failed), now.runs)
        for label, total in now.tasks.items():
            show(label, now.tasks_done[label], total)

    return show_sweep


def print_survey(found: Survey) -> None:
    """Print the numbers of runs, and of tasks by stage."""
    refused = f", {found.runs_refused} that cannot be run" if found.runs_refused else ""
    lines = [f"{found.runs} runs, {found.runs_finished} of them finished{refused}"]
    print_lines([*lines, *filter(None, [found.why_refused])])
    headings = [("stage", ""), *((name, "d") for name in ("wanted", "shared", "finished", "to do"))]
    rows = []
    for label, wanted in found.wanted.items():
        done, left = found.finished[label], found.left[label]
        rows.append((label, wanted, wanted - done - left, done, left))
    print_table(headings, rows, "Tasks", "shared: wanted by several runs, done once")


def print_sweep(dataset: SweepDataset, runs: Sequence[SweepRun], failed: Mapping[str, str]) -> None:
    """Print medians over the runs, and the failures."""
    finished = [run for run in runs if run.run_id not in failed]
    lines = []
    if finished:
        summary = medians_over_runs(dataset, finished)
        keys = (key.rpartition(".")[2] for key in dataset.keys)
        shown_columns = columns("", setting=" ".join(("scenario", *keys)), aligner="aligner")
        for error, column, stage in zip(ERRORS, GIVEN, ("estim.", "refined"), strict=True):
            shown_columns |= columns(".3f", **{error: f"{stage}\nm"})
            shown_columns |= columns(".0%", **{column: "\ngiven"})
        shown_columns |= columns("d", runs="runs")
        title = f"Median translation errors over runs, {ANSWERABLE_PAIRS}+ true correspondences"
        print_frame(summary.head(MAX_ROWS_SHOWN), shown_columns, title, NO_ESTIMATE)
        if len(summary) > MAX_ROWS_SHOWN:
            lines.append(f"... and {len(summary) - MAX_ROWS_SHOWN} more rows")
    shown_columns = sorted(failed)[:MAX_FAILURES_SHOWN]
    lines += [f"  {run_id} failed: {failed[run_id]}" for run_id in shown_columns]
    if len(failed) > MAX_FAILURES_SHOWN:
        lines.append(f"  ... and {len(failed) - MAX_FAILURES_SHOWN} more failed")
    print_lines([*lines, f"{len(finished)} of {len(runs)} runs finished; tables: {dataset.folder}"])


_CONSTANTS = ("distance", "turn", "late_turn", "bias_rad_per_m", "in_place")
_TITLES = ("distance\n%", "turn\n%", "late turn\n%", "bias\nmrad/m", "in place\n%")
_UNITS = (100.0, 100.0, 100.0, 1000.0, 100.0)
_SHOWN = columns("", robot="robot") | columns(">", **dict(zip(_CONSTANTS, _TITLES, strict=True)))


def calibration_rows(calibration: Calibration) -> list[dict[str, Any]]:
    """Return the constants of each robot with their standard errors."""
    return [
        {"robot": each.robot}
        | dict(zip(_CONSTANTS, each.error.constants.tolist(), strict=True))
        | {
            f"{name}_sigma": float(sigma)
            for name, sigma in zip(_CONSTANTS, each.standard_errors, strict=True)
        }
        for each in calibration.robots
    ]


def document(calibration: Calibration, written: Sequence[Path]) -> dict[str, Any]:
    """Return the content of `--json`."""
    errors = zip(NOISE_PARAMETERS, calibration.relative_errors, strict=True)
    return {
        "robots": calibration_rows(calibration),
        "settings": filter_settings(calibration),
        "relative_errors": {name: float(value) for name, value in errors},
        "n_rounds": calibration.n_rounds,
        "settled": calibration.converged,
        "logs": [str(path) for path in written],
    }


def print_calibration(calibration: Calibration, written: Sequence[Path]) -> None:
    """Print the constants, and the section for a scenario."""
    rows = []
    for each in calibration.robots:
        values = zip(each.error.constants, each.standard_errors, _UNITS, strict=True)
        texts = (f"{unit * value:+.1f} ± {unit * sigma:.1f}" for value, sigma, unit in values)
        rows.append({"robot": each.robot} | dict(zip(_CONSTANTS, texts, strict=True)))
    print_frame(
        pd.DataFrame(rows),
        _SHOWN,
        "Corrections of the odometry",
        "late turn: share of the previous turn that is made now; in place: of turns on the spot,\n"
        "relative to turns while driving",
    )
    if not calibration.converged:
        n_rounds = calibration.n_rounds
        print_lines([f"  not settled: constants or levels still change after {n_rounds} rounds"])
    print_lines([f"  {path}: corrected" for path in written])
    if written:
        print_lines(["For a scenario with the corrected logs:"])
        YAML().dump(filter_settings(calibration), sys.stdout)


_RATES = columns(
    ">",
    false="false\nmerges",
    wrong="wrong\n",
    missed="missed\nof all",
    missed_though_right="of right",
    few_missed_though_right="20 true:\nmissed",
    few_wrong="wrong",
)


def print_refusals(rows: Sequence[dict[str, Any]], false_alarms: float) -> None:
    """Print false and missed merges of each aligner in ordinary worlds (rows of `summary`)."""
    if not rows:  # all worlds contain repetitions
        return
    _print_rates(
        rows,
        _RATES,
        f"Accepted where chance gives at most {false_alarms:g} a pair of maps",
        "false: accepted without common ground; wrong: accepted with some, "
        f"{RIGHT_WITHIN_M:g} m or {RIGHT_WITHIN_RAD:g} rad off; missed: refused with "
        f"{MERGEABLE_PAIRS} or more true correspondences, of all and of those right; 20 true: "
        "just 20 in one corner are left",
    )
    wide = {
        name: f"{2 * float(name.removeprefix('poster_')):g} m\nwide"
        for name in rows[0]
        if name.startswith("poster_")
    }
    hung = {name: column for name, column in columns(">", **wide).items() if rows[0][name].n}
    if hung:
        what = "Accepted though wrong: one picture in two worlds"
        _print_rates(rows, hung, what, "wide: the picture hung in both")


def print_kinds(rows: Sequence[dict[str, Any]]) -> None:
    """Print false merges and verdicts for each kind of world (rows of `by_kind`)."""
    grouped = itertools.groupby(rows, key=lambda row: row["kind"])
    kinds = {kind: list(own) for kind, own in grouped}
    false = []
    for kind, own in kinds.items():
        (who, runs), (_, pairs) = (worst(own, name) for name in ("false_runs", "false_pairs"))
        false.append([kind, _hits(runs), _hits(pairs), who if runs.hits else ""])
    shown = columns(">", runs="runs", pairs="pairs of maps\nwithout common ground")
    print_table(
        [("kind of world", ""), *shown.values(), ("worst method\nof runs", "")],
        false,
        "Accepted though wrong, by kind of world",
        "of the method that is worst; runs: any of their maps",
    )
    found = []
    for kind, own in kinds.items():
        shares = [_hits(pooled(own, f"right_{verdict}")) for verdict in VERDICTS]
        first = [own[0][name] for name in ("first_iteration", "first_iteration_by_chance")]
        times = ["–" if math.isnan(value) else f"{value:.0f}" for value in first]
        found.append([kind, *shares, *times])
    shown = columns(
        ">", accepted="accepted", ambiguous="ambi-\nguous", uncertain="too un-\ncertain"
    )
    shown |= columns(">", refused="refused", first="first at\niteration", chance="by\nchance")
    print_table(
        [("kind of world", ""), *shown.values()],
        [row for row in found if row[1:] != ["–"] * (len(row) - 1)],
        "Right answers, by kind of world",
        f"of all methods, with {MERGEABLE_PAIRS} or more true correspondences; first: a run's "
        f"first right answer that is accepted (median, {rows[0]['aligner']}), and by the test "
        "against chance alone",
    )


def _hits(rate: Rate) -> str:
    """Return hits/n; a dash without cases."""
    return f"{rate.hits}/{rate.n}" if rate.n else "–"


def print_guarantee(found: Guarantee) -> None:
    """Print the shares of false runs, and the lowest threshold with a guarantee."""
    confidence = f"{1 - found.delta:.4g}"
    shown = {"scenario": ("scenario", "")}
    shown |= columns("d", n_runs="runs", n_false_runs="false\nruns")
    shown |= columns(".2%", false_runs_upper="at most")
    shown |= columns("d", n_right="right\nanswers") | columns(".1%", accepted="accepted\n95 %")
    note = f"at most: Clopper-Pearson, one-sided, confidence {confidence}; false: any method merges"
    print_frame(found.shares, shown, "Runs with a false merge", note)
    # The certified threshold, and what limits it.
    best, n_runs = found.certified, len(found.answers.runs)
    if best is None:
        needed = clean_runs_needed(found.alpha, found.delta)
        k = int(found.thresholds["n_false_runs"].iloc[0]) if len(found.thresholds) else 0
        why = f"{k} of {n_runs} runs are false at the highest threshold"
        lines = [f"no threshold is certified: {why}; {needed} runs without a false one are needed"]
    else:
        aim = f"at most {found.alpha:.2%} of runs have a false merge (confidence {confidence})"
        lines = [f"lowest certified align.evidence.least_ratio: {best['least_ratio']:.4g}; {aim}"]
        if best["n_right"]:
            share = interval(*best[["accepted", "accepted_low", "accepted_high"]], layout=".1%")
            lines.append(f"  right answers accepted with it: {share} of {best['n_right']}")
    if found.least_ratio > 1:
        lines.append(
            f"made with least_ratio {found.least_ratio:g}: lower thresholds cannot be judged; "
            "runs with --set align.evidence.least_ratio=1 tell"
        )
    if n := found.answers.n_with_any_ratio:
        why = "maps without viewing evidence, or tables of an earlier version"
        lines.append(f"accepted with any threshold: {n} answers ({why})")
    if seeds := found.answers.shared_seeds:
        what = f"seed {seeds[0]}" + (f" and {len(seeds) - 1} more" if seeds[1:] else "")
        lines.append(
            f"{what}: of several scenarios, whose worlds may have parts in common; bounds over all "
            "scenarios need a seed of its own for each run"
        )
    if found.n_failed:
        lines.append(f"failed and not counted: {found.n_failed} runs")
    print_lines(lines)


def _print_rates(
    rows: Sequence[dict[str, Any]], shown: Mapping[str, Column], title: str, note: str
) -> None:
    """Print rates by aligner."""
    cells = [
        [row["aligner"], *(f"{row[name].hits}/{row[name].n}" for name in shown)] for row in rows
    ]
    print_table([("aligner", ""), *shown.values()], cells, title, note)
