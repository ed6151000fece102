"""What `run` and `check` show."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from rich.text import Text

from experiments.judge import tables
from experiments.judge.checking import CheckedScenario
from experiments.judge.criteria import ANSWERABLE_PAIRS, ORACLE, answerable, at_the_end
from experiments.judge.judged_maps import methods_in
from experiments.judge.path_errors import path_rms
from experiments.judge.tables import SHOWN
from experiments.show.terminal.layout import (
    NO_ESTIMATE,
    columns,
    print_frame,
    print_lines,
    print_skipped,
    print_table,
)
from experiments.study.statistics.error_bands import ROBOT_PAIR, error_bands
from experiments.study.statistics.standing import aligner_summary
from mapfusion.align.result import NOT_RUN, Status

_SEEDS_SHOWN = 3  # one by one, in a table of checks


def print_result(result: Path, skipped_figures: Sequence[str]) -> None:
    """The table of all aligners, and where everything is."""

    def table(name: str) -> pd.DataFrame:
        return tables.read(tables.table_path(result, name), name)

    errors = table("errors")
    aligners = methods_in(errors, oracle=True)
    if aligners:  # else a robot that was alone
        _print_aligners(errors, aligner_summary(errors, table("aligner_timings"), aligners))
        print_lines(f"  {line}" for line in not_run_lines(errors))
        _print_pairs(errors, aligners[0])
    elif len(estimates := table("estimates")):
        _print_answers(estimates)
        print_lines(f"  {line}" for line in not_run_lines(estimates))
    shown = columns("", robot="robot") | columns(".3f", path_m="FastSLAM, m")
    shown |= columns(".3f", odometry_m="odometry, m") | columns(".2f", over_odometry="ratio")
    shown |= columns("d", n_landmarks="landmarks\never seen")
    paths = path_rms(table("robots"))
    known = paths["path_m"].notna().any()
    print_frame(paths, shown, "Position errors (RMS)" if known else "Robots (no truth: no errors)")
    print_lines(
        ["  Maps and figures hold the landmarks that were seen often enough (slam.min_count)."]
    )
    left_out = table("fused_motions")[["robot", "left_out"]].itertuples(index=False)
    print_lines(f"  {robot} is left out of the fused map: {why}" for robot, why in left_out if why)
    print_lines([f"Figures: {result / 'figures'}   tables: {result / 'tables'}"])
    print_skipped(skipped_figures)


def _print_answers(estimates: pd.DataFrame) -> None:
    """Without truth: how often each aligner answered, was refined and was accepted."""
    by_aligner = estimates.groupby("aligner", sort=False)
    shares = {
        name: by_aligner[column].agg(lambda told: (told == Status.ACCEPTED).mean())
        for name, column in (("estimated", "status"), ("refined", "refined_status"))
    }
    rows = pd.DataFrame(shares | {"accepted": by_aligner["accepted"].mean()}).reset_index()
    shown = columns("", aligner="aligner")
    shown |= columns(".0%", estimated="estimated", refined="refined", accepted="accepted")
    note = "share of all maps and repetitions; accepted: as more than chance"
    print_frame(rows, shown, "Answers (no truth: errors are unknown)", note)


def not_run_lines(errors: pd.DataFrame) -> list[str]:
    """One line for each aligner, and each reason, that did not run."""
    not_run = errors[errors["status"].isin(NOT_RUN)]
    n_rows = errors.groupby("aligner").size().to_dict()
    lines, causes = [], ["aligner", "status", "reason"]
    for (aligner, status, reason), rows in not_run.groupby(causes, sort=False):
        share = "" if status == Status.ABSENT else f" in {len(rows)} of {n_rows[aligner]} rows"
        lines.append(f"{aligner}: {status}{share}: {reason}")
    return lines


def _print_aligners(errors: pd.DataFrame, summary: pd.DataFrame) -> None:
    shown = columns("", aligner="aligner")
    shown |= {name: (column.label, column.layout) for name, column in SHOWN.items()}
    shown |= columns(".3f", spread_m="spread\nm") | columns(".2f", time_ms="time\nms")
    maps = answerable(errors)
    note = f"{NO_ESTIMATE}\n"
    note += "spread: 10-90 % of the repetitions; ok: accepted as more than chance"
    if len(maps):
        n_offered = maps["n_correspondences"]
        share = (maps["n_true"] / n_offered).median()
        note += f"\npairs offered: {n_offered.median():.0f}, {share:.0%} of them true"
    title = f"Alignment errors: medians over iterations with {ANSWERABLE_PAIRS}+ true pairs"
    print_frame(summary, shown, title, note)


def _print_pairs(errors: pd.DataFrame, aligner: str) -> None:
    """Each pair at its last iteration: the first aligner, refined, beside the oracle."""
    shown = [("pair", "")]
    for whose in ("error", "oracle"):
        shown += [(f"{whose}, m", ".3f"), (f"{whose}, rad", "+.4f")]
    names = [f"refined_{quantity}" for quantity in ("translation_error_m", "rotation_error_rad")]
    bands = at_the_end(error_bands(errors)).set_index([*ROBOT_PAIR, "aligner"])
    medians = bands[names].T.to_dict("list")
    rows = []
    for last in at_the_end(errors).drop_duplicates(ROBOT_PAIR).to_dict("records"):
        pair = (last["robot_a"], last["robot_b"])
        found = (*medians[(*pair, aligner)], *medians[(*pair, ORACLE)])
        rows.append([" - ".join(pair), *found, f"{last['n_true']} of {last['n_correspondences']}"])
    title = f"Pairs at the last iteration, {aligner} refined"
    print_table([*shown, ("true pairs", ">")], rows, title)


def print_checks(checks: Sequence[CheckedScenario]) -> None:
    """The table of a check."""
    outcomes = [outcome for check in checks for outcome in check.outcomes]
    shown = columns("", scenario="scenario", metric="metric") | columns(".4g", value="measured")
    shown |= columns("", bound_text="expected", seeds="by seed", verdict="")
    rows = []
    for outcome in outcomes:
        seeds = _by_seed(list(outcome.per_seed.values()))
        verdict = Text("pass", "green") if outcome.passed else Text("FAIL", "bold red")
        what = (outcome.scenario, outcome.metric, outcome.value, outcome.bound_text)
        rows.append((*what, seeds, verdict))
    print_table(shown.values(), rows, "Checks against the truth")
    failed = sum(not outcome.passed for outcome in outcomes)
    not_run = sum(bool(check.error) for check in checks)
    of_all = f"{not_run} of {len(checks)} scenarios"
    errors = f"; {of_all} could not be checked" if not_run else ""
    print_lines([f"{len(outcomes) - failed} passed, {failed} failed{errors}"])


def _by_seed(values: Sequence[float]) -> str:
    """Each seed's value; of more than a line holds the smallest and the largest."""
    if len(values) <= _SEEDS_SHOWN:
        return "  ".join(f"{value:.3g}" for value in values)
    return f"{min(values):.3g} to {max(values):.3g}"
