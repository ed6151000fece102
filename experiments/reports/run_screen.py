"""Screens of `run`, `check`, `align`, `merge` and `import`."""

import math
import shlex
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
from rich.text import Text

from experiments.evaluation import tables
from experiments.evaluation.adoption import ADOPTED, NO_TEAM
from experiments.evaluation.alignment_criteria import (
    ANSWERABLE_PAIRS,
    ORACLE,
    answerable,
    at_last_iteration,
    has_common_ground,
    is_used_by_team,
    merged_robots,
    methods_in,
    path_rms,
    right_refined,
    summarise_alignments,
)
from experiments.evaluation.map_consistency import GROSS_M
from experiments.evaluation.map_errors import last_fused
from experiments.evaluation.metrics import CheckedScenario
from experiments.evaluation.result import renderer
from experiments.evaluation.run_plan import RunPlan
from experiments.evaluation.single_steps import alignment_row
from experiments.evaluation.tables import SHOWN, read_provenance, read_scenario
from experiments.pipeline.stereo_import import ImportedRecording
from experiments.pipeline.tables import covariances_of
from experiments.reports.layout import (
    NO_ESTIMATE,
    columns,
    listed,
    metres,
    percent,
    print_frame,
    print_lines,
    print_skipped,
    print_table,
    radians,
    two_digits,
)
from experiments.studies.method_comparison import Recommendation, aligner_summary, recommend
from experiments.studies.statistics import ROBOT_PAIR, error_bands
from mapfusion.align.alignment import NOT_RUN, Status
from mapfusion.fusion.map_merging import (
    MapAlignment,
    MergedMaps,
    advice,
    best_alignment,
    motion_text,
    sigma_number,
    sigma_text,
)
from mapfusion.fusion.team_graph import EdgeStatus
from mapfusion.geometry.se2 import motion_sigma
from sim.renderer import NAMES


def team_lines(motions: pd.DataFrame, team: pd.DataFrame, pairs: pd.DataFrame) -> Iterator[str]:
    """Describe a team by the tables `fused_motions`, `team` and `team_pairs` of one run.

    A single robot gives no lines. Without truth the last two tables have no rows, and their lines
    are left out.
    """
    final = team[team["source"] == "final"]
    for row in final[final["n_team"] > 1].to_dict("records"):
        which = "are merged" if row["component"] == 1 else "make a map of their own"
        off = f"their paths err by {two_digits(row['rmse'])} m (ATE, one rigid fit for all)"
        yield f"{row['n_robots']} of {row['n_team']} robots {which}: {off}"
    if len(motions) and not merged_robots(motions["tx_m"]):
        alone = motions.loc[motions["tx_m"].notna(), "robot"].tolist()
        yield f"no two maps were merged, the fused map is that of {listed(alone)}"
    for robot, why in motions[["robot", "left_out"]].itertuples(index=False):
        if why:
            yield f"{robot} is left out of the fused map: {why}"
    if len(pairs):
        met, used, right = has_common_ground(pairs), is_used_by_team(pairs), right_refined(pairs)
        found = (used & met & right).sum()
        yield (
            f"alignments believed: {used.sum()}, right: {found}; "
            f"pairs of maps with common ground: {met.sum()}, found: {found}"
        )


def edge_lines(edges: pd.DataFrame) -> Iterator[str]:
    """Describe by `team_edges` how alignments agree; a single alignment gives no lines."""
    if len(edges) > 1:
        used = edges[edges["place"] != EdgeStatus.REFUSED]
        for place, rows in used.groupby("place", sort=True):
            names = (rows["robot_a"] + "-" + rows["robot_b"]).tolist()
            yield f"alignments {place}: {listed(names)}"


def adoption_lines(adoptions: pd.DataFrame, messages: pd.DataFrame) -> Iterator[str]:
    """Describe by `adoptions` and `messages` what robots adopted while they drove."""
    for row in adoptions.to_dict("records"):
        why = f": {row['reason']}" if row["reason"] else ""
        off = ""
        if row["event"] == ADOPTED and not math.isnan(row["translation_error_m"]):
            off = f", {metres(row['translation_error_m'])} off"
        words = {"on trial": "has the map of {} on trial", "kept": "keeps the map of {} for now"}
        words["not smoothed"] = "neither sends nor merges"
        text = words.get(row["event"], f"{row['event']} the map of {{}}").format(row["other"])
        yield f"{row['iteration']:>5}  {row['robot']} {text}{off}{why}"
    if len(messages):
        lost, size = int(messages["lost"].sum()), messages["n_bytes"].sum() / 1e3
        yield f"{len(messages)} messages with {size:.0f} kB, {lost} of them lost"


_SEEDS_SHOWN = 3  # one by one, in a table of checks

# Columns of the tables of a run
_ALIGNERS = columns("", aligner="aligner")
_ALIGNERS |= {name: (column.label, column.layout) for name, column in SHOWN.items()}
_ALIGNERS |= columns(".3f", spread_m="spread\nm") | columns(".2f", time_ms="time\nms")
_MEMBERS = columns("", robot="robot")
_MEMBERS |= columns(".4f", merged_path_rmse_m="path\nm", alone_merged_path_rmse_m="alone\nm")
_MEMBERS |= columns(".2f", over_alone="path /\nalone") | columns("d", n_adopted="adopted\n")
_MEMBERS |= columns(".4f", landmark_rmse_m="error\nm") | columns(
    ".2f", frame_nees_per_dof="NEES\n/ dof"
)
_MEMBERS |= columns(".0%", frame_coverage_95="in\n95 %", shared_share="shared\n")
_MEMBERS |= columns(".0f", sent_kb="sent\nkB")
_SMOOTHED = columns("", aligner="aligner")
_SMOOTHED |= columns(".3f", filter_m="FastSLAM's\nm") | columns(".0%", filter_ok="\nok")
_SMOOTHED |= columns(".3f", smoothed_m="smoothed\nm") | columns(".0%", smoothed_ok="\nok")
_PAIRS = [("maps", ""), ("error, m", ".3f"), ("error, rad", "+.4f")]
_PAIRS += [("oracle, m", ".3f"), ("oracle, rad", "+.4f"), ("correspondences\ntrue", ">")]
_ANSWERS = columns("", aligner="aligner")
_ANSWERS |= columns(".0%", estimated="estimated", refined="refined", accepted="accepted")
_PATHS = columns("", robot="robot") | columns(".3f", path_m="FastSLAM, m")
_PATHS |= columns(".3f", odometry_m="odometry, m") | columns(".2f", over_odometry="ratio")
_PATHS |= columns("d", n_landmarks="landmarks\never seen")
_SMOOTHER = columns("", robot="robot") | columns(".3f", path_rmse_m="path, m")
_SMOOTHER |= columns(".1f", filter_over_smoother="FastSLAM\n/ smoother")
_SMOOTHER |= columns(".3f", landmark_rmse_m="landmarks\nm")
_SMOOTHER |= columns(".3f", filter_landmark_rmse_m="FastSLAM's\nm")
_SMOOTHER |= columns(".1%", gross_share="gross\n") | columns(".2f", nees_per_dof="NEES\n/ dof")
_SMOOTHER |= columns(".0%", coverage_95="in\n95 %")
_FUSERS = columns("", fuser="fuser") | columns(".3f", landmark_rmse_m="frame\nm")
_FUSERS |= columns(".3f", fitted_rmse_m="fitted\nm") | columns(".1%", gross_share="gross\n")
_FUSERS |= columns(".2f", over_better_parent="over\nparent", over_better_filter="over\nfilter")
_FUSERS |= columns(".2f", nees_per_dof="NEES\n/ dof") | columns(".0%", coverage_95="in\n95 %")
_FUSERS |= columns(".3f", alignment_error_m="T_a_b\nm", alignment_sigma_m="sigma\nm")
_TEAM_PAIRS = columns("", pair="maps", place="their alignment")
_TEAM_PAIRS |= columns(".3f", refined_translation_error_m="alone\nm")
_TEAM_PAIRS |= columns("+.4f", refined_rotation_error_rad="\nrad")
_TEAM_PAIRS |= columns(".3f", team_translation_error_m="in the team\nm")
_TEAM_PAIRS |= columns("+.4f", team_rotation_error_rad="\nrad") | columns("d", n_common="common")
_WORK = columns("", stage="stage") | columns(".1f", seconds="work, s")
_WORK |= columns(".0%", share="share") | columns("d", tasks="tasks")


def print_plan(plan: RunPlan, results: Path, jobs: int) -> None:
    """Print the tasks of a planned run, and an estimate of its time and memory."""
    frames = sorted(set(plan.n_frames.values()))
    n_frames = f"{frames[0]}" + (f" to {frames[-1]}" if len(frames) > 1 else "")
    n_robots, source = len(plan.n_frames), images_by(renderer(plan.scenario))
    shown = columns("", name="stage") | columns("d", finished="finished", to_do="to do")
    shown |= columns(".1f", work_s="work, s")
    basis = "typical rates of two cores; this machine may need half or twice as long"
    if plan.n_earlier:
        runs = "1 earlier run" if plan.n_earlier == 1 else f"{plan.n_earlier} earlier runs"
        basis = f"the rates of {runs} in {results}"
    processes = "1 process" if jobs == 1 else f"{jobs} processes"
    memory_gb = jobs * plan.process_bytes / 1e9
    print_frame(
        pd.DataFrame(map(asdict, plan.stages)),
        shown,
        f"{plan.scenario.name}, seed {plan.scenario.seed}: {n_robots} robots, {n_frames} frames "
        f"each; images: {source}",
    )
    print_lines(
        [
            f"Estimate: {plan.elapsed_s:.0f} s with {processes} ({plan.work_s:.0f} s of work), "
            f"{memory_gb:.1f} GB of memory at most.",
            f"  It uses {basis}.",
            "  A first run also compiles kernels, one to two minutes. Nothing was run.",
        ]
    )


def images_by(name: str) -> str:
    """Say who draws images, by the name of the renderer in a result."""
    return name.replace(NAMES["tiny"], f"PyBullet's {NAMES['tiny']}")


def closing_lines(result: Path) -> tuple[str, str]:
    """Return two lines: the method to use, and the command that opens the report."""
    errors = tables.read(tables.table_path(result, "errors"), "errors")
    if errors.empty:  # no truth: name the aligners whose last alignments were accepted
        estimates = tables.read(tables.table_path(result, "estimates"), "estimates")
        advice = "Method to use: unknown. There are no two maps to align."
        if len(estimates):
            last = at_last_iteration(estimates)
            last = last[last["repetition"] == 0]
            accepted = last.groupby("aligner", sort=False)["accepted"].agg(["sum", "count"])
            n_most, n_pairs = int(accepted["sum"].max()), int(accepted["count"].max())
            most = accepted.index[accepted["sum"] == n_most].tolist()
            advice = (
                f"Method to use: {listed(most)} had {n_most} of {n_pairs} pairs of maps accepted; "
                "no truth is known, so errors are not."
            )
            if not n_most:
                advice = "Method to use: unknown. No alignment was accepted, and no truth is known."
    else:
        timings = tables.read(tables.table_path(result, "aligner_timings"), "aligner_timings")
        run = errors.assign(run_id="this", scenario="this", seed=0)
        advice = method_advice(recommend(summarise_alignments(run), timings, methods_in(errors)))
    return advice, f"Open the report: mapfusion report {shlex.quote(str(result))} --open"


def method_advice(found: Recommendation) -> str:
    """Say in one line which aligner to use, how accurate it was, and how sure that is."""
    best, hint = found.best, "One run is a hint; a sweep over seeds decides."
    if not found.n_common:
        wrong = [standing.aligner for standing in found.standings if standing.n_false]
        merged = f"but {listed(wrong)} accepted a wrong alignment" if wrong else "and all refused"
        return f"Method to use: none. No two maps share ground, {merged}. {hint}"
    if best is None:
        tried = f"No method was right on the {found.n_common} pairs of maps with common ground."
        return f"Method to use: none. {tried} {hint}"
    name = best.aligner if found.reliable else f"none is reliable. The best is {best.aligner}"
    how = (
        f"It was right in {percent(best.rate)} of {best.alignments}, median error "
        f"{metres(best.refined_m)} and {radians(best.refined_rad)}"
    )
    if best.n_false:
        how += f", but {best.n_false} of {best.n_accepted} accepted alignments were wrong"
    elif not best.n_accepted:
        how += ", but none of its alignments was accepted"
    if found.equals:
        verb = "does" if len(found.equals) == 1 else "do"
        hint = f"{listed(found.equals)} {verb} as well as far as this run can tell. {hint}"
    return f"Method to use: {name}. {how}. {hint}"


def _filter_beside_smoothed(errors: pd.DataFrame, smoothed: pd.DataFrame) -> pd.DataFrame:
    """Return errors and accepted shares of both kinds of maps at the smoothed iterations."""
    rows: dict[str, pd.Series] = {}
    at_both = errors[errors["iteration"].isin(smoothed["iteration"])]
    for kind, own in (("filter", at_both), ("smoothed", smoothed)):
        by_aligner = summarise_alignments(answerable(own)).groupby("aligner", sort=False)
        rows[f"{kind}_m"] = by_aligner["refined_translation_error_m"].median()
        rows[f"{kind}_ok"] = by_aligner["accepted"].mean()
    table = pd.DataFrame(rows)
    return table.loc[[*methods_in(table.reset_index(), oracle=True)]].reset_index()


def print_result(result: Path, skipped_figures: Sequence[str] | None) -> None:
    """Print the tables of a run, and the folders of tables and figures; None: no figures."""

    def table(name: str) -> pd.DataFrame:
        return tables.read(tables.table_path(result, name), name)

    errors = table("errors")
    aligners = methods_in(errors, oracle=True)
    if aligners:
        note = f"{NO_ESTIMATE}\nspread: 10-90 % of the repetitions; ok: accepted"
        if len(maps := answerable(errors)):
            n_offered = maps["n_correspondences"]
            share = (maps["n_true"] / n_offered).median()
            note += (
                f"\ncorrespondences: {n_offered.median():.0f} (median), {share:.0%} of them true"
            )
        title = f"Alignment errors: medians over pairs of maps with {ANSWERABLE_PAIRS} or more "
        title += "true correspondences"
        summary = aligner_summary(errors, table("aligner_timings"), aligners)
        print_frame(summary, _ALIGNERS, title, note)
        print_lines(f"  {line}" for line in not_run_lines(errors))
        smoothed = table("smoothed_errors")
        if len(answerable(smoothed)):
            note = "at the iterations at which maps are fused; inf: no estimate on most of them\n"
            note += "ok: accepted"
            rows = _filter_beside_smoothed(errors, smoothed)
            print_frame(rows, _SMOOTHED, "Refined errors on FastSLAM's and on smoothed maps", note)
        # Each pair at its last iteration: the first aligner, refined, beside the oracle
        names = ["refined_translation_error_m", "refined_rotation_error_rad"]
        bands = at_last_iteration(error_bands(errors)).set_index([*ROBOT_PAIR, "aligner"])
        medians = bands[names].T.to_dict("list")
        rows = []
        for last in at_last_iteration(errors).drop_duplicates(ROBOT_PAIR).to_dict("records"):
            pair = (last["robot_a"], last["robot_b"])
            found = (*medians[(*pair, aligners[0])], *medians[(*pair, ORACLE)])
            n_true = f"{last['n_true']} of {last['n_correspondences']}"
            rows.append([" - ".join(pair), *found, n_true])
        print_table(_PAIRS, rows, f"Pairs of maps at the last iteration, {aligners[0]} refined")
    elif len(estimates := table("estimates")):
        # Without truth: shares of maps and repetitions
        by_aligner = estimates.groupby("aligner", sort=False)
        shares = {
            name: by_aligner[column].agg(lambda status: (status == Status.ACCEPTED).mean())
            for name, column in (("estimated", "status"), ("refined", "refined_status"))
        }
        rows = pd.DataFrame(shares | {"accepted": by_aligner["accepted"].mean()}).reset_index()
        note = "share of all maps and repetitions; accepted: more than chance, not contradicted"
        print_frame(rows, _ANSWERS, "Answers (no truth: errors are unknown)", note)
        print_lines(f"  {line}" for line in not_run_lines(estimates))
    paths = path_rms(table("robots"))
    known = paths["path_m"].notna().any()
    print_frame(paths, _PATHS, "Position errors (RMS)" if known else "Robots (no truth: no errors)")
    print_lines(["  Maps and figures contain landmarks with slam.min_count or more observations."])
    smoother = table("smoother")
    smoothed = smoother[smoother["not_smoothed"] == ""]
    if smoothed[["path_rmse_m", "landmark_rmse_m"]].notna().any(axis=None):
        note = f"paths from the start; landmarks fitted, without gross ones (over {GROSS_M} m)"
        print_frame(smoothed, _SMOOTHER, "Batch smoother beside the filter", note)
    reasons = smoother[["robot", "not_smoothed"]].itertuples(index=False)
    print_lines(f"  {robot} is not smoothed: {why}" for robot, why in reasons if why)
    fused = last_fused(table("fusers"))
    note = f"RMS errors in the map's frame and fitted, without gross ones (over {GROSS_M} m)\n"
    note += "over: fitted error over that of the better given map, and FastSLAM map\n"
    note += "T_a_b: median error of the other robots' poses, with the stated sigma"
    print_frame(fused, _FUSERS, "Fusers: maps of all robots together, at the end", note)
    reasons = fused[["fuser", "fallback"]].itertuples(index=False)
    print_lines(f"  {fuser}: {why}" for fuser, why in reasons if why)
    pairs = table("team_pairs")
    if len(pairs) > 1:
        names = pairs["robot_a"] + " - " + pairs["robot_b"]
        note = "errors of T_a_b, from the alignment of both maps and from all of the team\n"
        note += "their alignment: agreement with loops of the others; common: landmarks of both"
        print_frame(pairs.assign(pair=names), _TEAM_PAIRS, "Pairs of maps in the team", note)
    members = table("team_members")
    if len(members):
        last = members.sort_values("iteration").groupby("robot", sort=False).tail(1)
        last = last.assign(over_alone=last["merged_path_rmse_m"] / last["alone_merged_path_rmse_m"])
        note = "path errors (RMS) since the first adoption, of the independent robot and smoothed\n"
        note += "adopted: landmarks that another robot observed first, and their RMS error\n"
        note += "shared: observations of landmarks that other robots mapped, too"
        print_frame(last, _MEMBERS, "Robots that exchange maps while they drive", note)
        lines = adoption_lines(table("adoptions"), table("messages"))
        print_lines(f"  {line}" for line in lines)
    # Work of each stage, and of a run beside its stages
    times = tables.work_by_stage(table("timings"))
    times["share"] = times["seconds"] / times["seconds"].sum()
    note = "time of one process at a time, including work of earlier runs\n"
    note += "start: imports and the scenario, in this command's own process"
    print_frame(times, _WORK, "Work by stage", note)
    team = team_lines(table("fused_motions"), table("team"), pairs)
    print_lines(f"  {line}" for line in (*team, *edge_lines(table("team_edges"))))
    if len(fused) and len(motions := table("fused_motions")) > 1:
        scenario = read_scenario(result / "scenario.json")
        chosen = fused[fused["fuser"] == scenario["merge"].get("fuser")]
        for row in chosen.to_dict("records"):
            by = f"{row['n_robots']} of {len(motions)} robots, by {row['fuser']}"
            print_lines([f"  maps/fused.parquet: {by}"])
    drawn = [] if skipped_figures is None else [f"Figures: {result / 'figures'}"]
    print_lines(["   ".join([*drawn, f"Tables: {result / 'tables'}"])])
    renderer = read_provenance(result / "provenance.json").get("renderer", "unknown")
    print_lines([f"Images of the cameras: {images_by(str(renderer))}"])
    print_skipped([line for line in skipped_figures or () if not line.endswith(NO_TEAM)])


def not_run_lines(errors: pd.DataFrame) -> list[str]:
    """Return one line for each aligner that did not run and each reason."""
    not_run = errors[errors["status"].isin(NOT_RUN)]
    n_rows = errors.groupby("aligner").size().to_dict()
    lines, causes = [], ["aligner", "status", "reason"]
    for (aligner, status, reason), rows in not_run.groupby(causes, sort=False):
        share = "" if status == Status.ABSENT else f" in {len(rows)} of {n_rows[aligner]} rows"
        lines.append(f"{aligner}: {status}{share}: {reason}")
    return lines


def print_checks(checks: Sequence[CheckedScenario]) -> None:
    """Print the table of a check."""
    outcomes = [outcome for check in checks for outcome in check.outcomes]
    shown = columns("", scenario="scenario", metric="metric") | columns(".4g", value="measured")
    shown |= columns("", bound_text="expected", seeds="by seed", verdict="")
    rows = []
    for outcome in outcomes:
        values = list(outcome.per_seed.values())
        seeds = f"{min(values):.3g} to {max(values):.3g}"
        if len(values) <= _SEEDS_SHOWN:
            seeds = "  ".join(f"{value:.3g}" for value in values)
        verdict = Text("pass", "green") if outcome.passed else Text("FAIL", "bold red")
        what = (outcome.scenario, outcome.metric, outcome.value, outcome.bound_text)
        rows.append((*what, seeds, verdict))
    print_table(shown.values(), rows, "Checks against the truth")
    print_lines(
        f"{check.scenario}, seed {seed}: {nothing.text}"
        for check in checks
        for seed, nothing in check.unmerged.items()
    )
    n_passed = sum(outcome.passed for outcome in outcomes)
    n_failed = len(outcomes) - n_passed + sum(len(check.unmerged) for check in checks)
    not_run = sum(bool(check.error) for check in checks)
    of_all = f"{not_run} of {len(checks)} scenarios"
    errors = f"; {of_all} could not be checked" if not_run else ""
    print_lines([f"{n_passed} passed, {n_failed} failed{errors}"])


_ALIGNMENTS = columns("", aligner="aligner", verdict="verdict")
_ALIGNMENTS |= columns(".3f", refined_tx_m="T_a_b\nx, m", refined_ty_m="\ny, m")
_ALIGNMENTS |= columns(".4f", refined_theta_rad="\nrad")
_ALIGNMENTS |= columns(">", sigma_m="sigma\nm", sigma_rad="\nrad", inliers="pairs\n")
_ALIGNMENTS |= columns(".0f", log10_false_alarms="NFA\nlog10")
_ALIGNMENTS |= columns(">", time="time\nms")
_LOWER_BOUND = "≥: a lower bound, since a map does not state the errors that its landmarks share"


def print_alignments(alignments: Sequence[MapAlignment]) -> None:
    """Print the alignments of two maps by all methods in one table, and what to use."""
    found = pd.DataFrame(map(alignment_row, alignments))
    sigma_m, sigma_rad = motion_sigma(covariances_of(found))
    at_overlap = [
        at if overlap is None else overlap.sigma_m
        for at, overlap in zip(sigma_m, found["overlap"], strict=True)
    ]
    bounds = ["≥ " if each else "" for each in found["lower_bound"]]

    def texts(sigma: Iterable[float], digits: int) -> list[str]:
        both = zip(bounds, sigma, strict=True)
        return ["–" if math.isnan(x) else f"{bound}{sigma_number(x, digits)}" for bound, x in both]

    shown = found.assign(
        verdict=[str(each.status).replace("_", " ") for each in alignments],
        sigma_m=texts(at_overlap, 3),
        sigma_rad=texts(sigma_rad, 4),
        inliers=found["n_inliers"].map(str) + "/" + found["n_correspondences"].map(str),
        time=(1e3 * found["elapsed_s"]).map(two_digits),
    )
    note = "T_a_b: refined; sigma: where the maps overlap; pairs: correspondences that\n"
    note += "support it; NFA: number of alignments with as much support by chance; time:\n"
    note += "of the estimate; more with --json"
    if (found["lower_bound"] & np.isfinite(at_overlap)).any():
        note += f"\n{_LOWER_BOUND}"
    print_frame(shown, _ALIGNMENTS, "", note)
    said = best_alignment(alignments).reason  # in the advice
    names = defaultdict[str, list[str]](list)  # of the methods, by the reason that they give
    for each in alignments:
        if not each.accepted and each.reason != said:
            reason = f"{str(each.status).replace('_', ' ')}: {each.bare_reason}"
            names[reason].append(each.aligner)
    print_lines(f"{listed(methods)}: {reason}" for reason, methods in names.items())
    print_lines([advice(alignments)])


def print_merged(merged: MergedMaps, maps: Sequence[Path], paths: Sequence[Path]) -> None:
    """Print the landmarks and motions of the fused maps, or why there are none, and what to do."""
    lines = []
    for path, fused in zip(paths, merged.fusion.fused, strict=False):
        several = int(((fused.parents >= 0).sum(axis=1) > 1).sum())
        lines.append(
            f"{len(fused.landmarks)} landmarks in {path}: fused from {len(fused.members)} maps, "
            f"aligned by {merged.aligner}; {several} landmarks are of several maps, "
            f"{fused.duplicate_share:.1%} look like remaining duplicates"
        )
        is_bound = merged.is_lower_bound(fused)
        motions = zip(maps, fused.T_first_map, fused.stated_covariance, strict=True)
        for k, (name, T, covariance) in enumerate(motions):
            if math.isnan(T[0]):
                continue
            stated = "the frame"
            if k != fused.members[0]:
                stated = f"{sigma_text(covariance, is_bound)} at its middle"
                height_m = 0.0 if fused.height_m is None else fused.height_m[k]
                if height_m:
                    way = "raised" if height_m > 0 else "lowered"
                    stated += f"; {way} by {abs(height_m):.3f} m"
            lines.append(f"  {name}: T_first_map = {motion_text(T)}, {stated}")
        lines += [f"  {_LOWER_BOUND}"] if is_bound else []
    if not paths and len(maps) > 2:  # of two maps the last sentence tells all
        lines += [
            f"  {maps[a]} and {maps[b]}: not merged: {reason}"
            for (a, b), reason in merged.reasons().items()
        ]
    print_lines([*lines, merged.advice])


_MOST_DROPPED = 5  # pictures that are listed
_COLUMNS = [
    ("robot", ""),
    ("frames", "d"),
    ("seconds", ".1f"),
    ("path, m", ".1f"),
    ("observations\na frame", ".0f"),
    ("\nat least", "d"),
    ("linked\n%", ".0f"),
    ("odometry", ""),
    ("truth", ""),
]


def print_imported(recordings: Sequence[ImportedRecording], folders: Sequence[Path]) -> None:
    """Print cameras, a line for each robot, dropped pictures, and the folders of the logs."""
    print_lines(one.about for one in recordings)
    note = "median over the frames; linked: share of the features of the frame before"
    rows = []
    for one in (robot for each in recordings for robot in each.robots):
        log, seen = one.log, one.observations
        known = 0 if one.truth is None else int(np.isfinite(one.truth).all(axis=1).sum())
        odometry = "recorded"
        if one.odometry_covariance is not None:
            odometry = f"pictures, {one.guessed} guessed" if one.guessed else "pictures"
        row = (
            log.robot,
            len(log),
            float(log.time_s[-1] - log.time_s[0]),
            float(np.hypot(*log.odometry[:, :2].T).sum()),
            float(np.median(seen)),
            int(seen[np.argmax(seen > 0) :].min()),  # tracks must last before any is observed
            100 * float(np.nanmedian(one.linked)),
            odometry,
            f"{known} frames" if known else "none",
        )
        rows.append(row)
    print_table(_COLUMNS, rows, "", note)
    print_lines(
        f"  {log.log.robot}: guessed motions: {log.guessed}, its map may break there; "
        "wheel odometry would bridge them"
        for one in recordings
        for log in one.robots
        if log.guessed
    )
    dropped = [text for one in recordings for text in one.dropped]
    print_lines(f"  dropped: {each}" for each in dropped[:_MOST_DROPPED])
    if len(dropped) > _MOST_DROPPED:
        print_lines([f"  dropped: {len(dropped) - _MOST_DROPPED} more"])
    print_lines(map(str, folders))
