"""Leaderboard: all aligners and fusers on a frozen set of tasks, ranked by stated rules.

Aligners. A decision on a pair of maps is right if a right alignment of maps with MERGEABLE_PAIRS or
more true pairs is accepted, or if any alignment of maps without common ground is refused. Other
pairs have no clear decision and do not count. One aligner beats another if its share of right
decisions is larger, or, where these shares cannot be told apart, if its errors before refinement
are smaller on maps with RICH_PAIRS or more true pairs. Both tests are paired, on the same maps.

Fusers. The last maps of each run are aligned with their true correspondences, so that the fuser
alone is judged. One fuser beats another if the RMS errors of its landmarks are smaller.

The rank of a method is one more than the number of methods that beat it. Methods of equal rank are
tied; the smaller error is listed first. A difference counts if a test over runs finds it at 5 %,
corrected for the number of pairs by Holm's method: Student's t test for aligners, Wilcoxon's
signed-rank test for fusers, whose errors may be infinite. Times are over those of a reference
method on the same maps in the same process, called directly afterwards.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import entry_points
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import tables
from experiments.evaluation.alignment_criteria import (
    ORACLE,
    has_common_ground,
    is_false_merge,
    mergeable,
    methods_in,
    right_refined,
    summarise_alignments,
)
from experiments.evaluation.map_errors import EvaluatedFusion, GivenMap, error_rows
from experiments.pipeline.stage import Job, Stage
from experiments.pipeline.stages.align import estimate_row, evidence_of
from experiments.pipeline.store import Store
from experiments.pipeline.tables import (
    COVARIANCE,
    FLOAT,
    INT,
    MOTION,
    TEXT,
    covariances_of,
    fields,
    read_rows,
    write_rows,
)
from experiments.pipeline.tasks import OnProgress, run_tasks, tasks_of
from experiments.pipeline.workers import single_threaded, workers
from experiments.plugins.discovery import (
    callable_aligner,
    code_of_fuser,
    find_method,
    known_methods,
)
from experiments.scenario.settings import DEFAULT_ALIGNERS, AlignerEntry
from experiments.scenario.suite import chosen_aligners
from experiments.studies.intervals import (
    SIGNIFICANCE,
    BetterTest,
    Interval,
    change_of_each_run,
    clusters_of,
    effective_trials,
    holm,
    log_ratio,
    mean_change,
    median_interval,
    signed_rank,
    wilson,
)
from experiments.studies.method_comparison import STAGES, compare_methods, oracle_ratios
from experiments.studies.statistics import alignment_nees
from experiments.studies.task_set import VERIFIER, Task, TaskSet, tasks_of_scenario
from mapfusion.align.alignment import Alignment, Pairs, Status, undetermined
from mapfusion.align.refinement import Oracle, Refinement
from mapfusion.errors import InputError, one_line
from mapfusion.files import schema
from mapfusion.fusion.fusers import (
    FUSERS,
    GROUP,
    REFERENCE,
    AlignedPair,
    Component,
    FusedMap,
    Fuser,
    MergeParameters,
    make_fuser,
)
from mapfusion.fusion.merge import connect
from mapfusion.geometry.numerics import Float, generator
from mapfusion.verification.false_alarms import Verdict
from mapfusion.verification.registration import PairRegistration, VerifiedRefinement

# Settings of the leaderboard, the same for all methods and versions of a set.
SEED = 0
TRUE_PAIR_RADIUS_M = 0.1  # the default of `evaluate.true_pair_radius_m`
REFERENCE_ALIGNER, REFERENCE_FUSER = "ransac", "kalman-drift"
_LABEL = "rank the methods"
# With fewer runs, even shares of right decisions of 50 and 90 % are seldom told apart at 5 % among
# a dozen methods.
RUNS_TO_RANK = 20
_ALIGNMENTS_FILE, _FUSIONS_FILE = "alignments.parquet", "fusions.parquet"
_TIMES = fields(elapsed_s=FLOAT, reference_s=FLOAT)
_TASK = fields(task=TEXT, run_id=TEXT, scenario=TEXT, seed=INT)
# One row per task and aligner: the columns of the table `errors`, and times of one call.
ALIGNMENTS = schema("leaderboard.alignments", 1, [*_TASK, *tables.ALL["errors"], *_TIMES])
# One row per run and fuser: the columns of the table `fusers`, and times of one call.
FUSIONS = schema("leaderboard.fusions", 1, [*_TASK[1:], *tables.ALL["fusers"], *_TIMES])


@dataclass(frozen=True)
class AlignerCell:
    """Settings of one aligner on the tasks of one scenario.

    `digest` identifies the content of the folder of the task set.
    """

    folder: str
    digest: str
    scenario: str
    name: str
    method: str
    parameters: dict[str, Any]
    time_limit_s: float
    origin: dict[str, str]


def run_aligner(settings: AlignerCell, job: Job) -> None:
    """Align the maps of each task and write the errors, those of the oracle too."""
    single_threaded()
    aligner = callable_aligner(settings.method, settings.parameters, settings.time_limit_s)
    reference = callable_aligner(REFERENCE_ALIGNER, {}, settings.time_limit_s)
    tasks, parts = tasks_of_scenario(Path(settings.folder), settings.digest, settings.scenario), []
    for number, task in enumerate(tasks):
        maps, offered = task.pair.maps, task.pair.offered
        evidence = evidence_of(task.pair.rivals, maps, VERIFIER.evidence)
        refinement = VerifiedRefinement(Pairs(*maps, offered), Refinement(), VERIFIER, evidence)
        on_pair = PairRegistration(aligner, refinement)
        for _ in range(1 if number else 2):  # the first call compiles and fills caches
            registered = on_pair.register(generator(SEED, "leaderboard", settings.name, task.name))
            beside = reference.align(*maps, offered, generator(SEED, "reference", task.name))
        row = task.pair.keys | {"aligner": settings.name, "repetition": 0}
        estimated, refined, verdict = registered
        row |= estimate_row(len(offered), estimated, refined, verdict)
        times = {"elapsed_s": estimated.elapsed_s, "reference_s": beside.elapsed_s}
        parts.append(_errors_of(task, row).assign(**times))
    write_rows(job.output / _ALIGNMENTS_FILE, ALIGNMENTS, pd.concat(parts, ignore_index=True))


def _errors_of(task: Task, row: Mapping[str, Any]) -> pd.DataFrame:
    """Return the errors of an estimate and of the oracle on a task, without times."""
    pair = replace(task.pair, estimates=(row,))
    return error_rows(pair, VERIFIER, TRUE_PAIR_RADIUS_M).assign(**task.keys)


@dataclass(frozen=True)
class FuserCell:
    """Settings of one fuser on the last maps of the runs of one scenario.

    `origin` identifies the code of a plug-in; empty for ours.
    """

    folder: str
    digest: str
    scenario: str
    fuser: str
    origin: str


def run_fuser(settings: FuserCell, job: Job) -> None:
    """Fuse the last maps of each run, aligned by their true correspondences; write the errors."""
    single_threaded()
    tasks, rows = tasks_of_scenario(Path(settings.folder), settings.digest, settings.scenario), []
    fuser, reference = make_fuser(settings.fuser), make_fuser(REFERENCE_FUSER)
    for seed in dict.fromkeys(task.seed for task in tasks):
        of_run = [task for task in tasks if task.seed == seed]
        last = max(task.pair.iteration for task in of_run)
        pairs = [task.pair for task in of_run if task.pair.iteration == last]
        robots = {robot.name: robot for pair in pairs for robot in (pair.a, pair.b)}
        place, aligned = {name: k for k, name in enumerate(robots)}, []
        for pair in pairs:
            found = Oracle().align(
                Pairs(*pair.maps, pair.offered), pair.is_true(TRUE_PAIR_RADIUS_M)
            )
            if found.ok:
                own = place[pair.a.name], place[pair.b.name]
                aligned.append(AlignedPair(*own, found, pair.offered))
        given = [GivenMap(robot, *robot.at(last), *robot.at(last)) for robot in robots.values()]
        maps = [each.landmarks for each in given]
        component = connect(maps, aligned, MergeParameters().team).components[0]
        if len(component.members) < 2:
            continue
        for _ in range(1 if rows else 2):  # the first call compiles and fills caches
            fused, elapsed_s = _timed_fusion(fuser, component)
            _, reference_s = _timed_fusion(reference, component)
        row = EvaluatedFusion(settings.fuser, last, fused, given).row()
        times = {"elapsed_s": elapsed_s, "reference_s": reference_s}
        rows.append(of_run[0].keys | row | times)
    write_rows(job.output / _FUSIONS_FILE, FUSIONS, rows)


def _timed_fusion(fuser: Fuser, component: Component) -> tuple[FusedMap, float]:
    """Return a fused map and the time of the call in s."""
    started_s = time.perf_counter()
    fused = fuser.fuse(component, MergeParameters())
    return fused, time.perf_counter() - started_s


def chosen_methods(
    methods: Sequence[str], only: bool = False
) -> tuple[tuple[AlignerEntry, ...], tuple[str, ...]]:
    """Return the aligners and fusers to rank: all known ones and the named ones.

    The fuser `batch` is not ranked: it smooths the logs again, which a task set does not have.

    Args:
        methods: names of aligners or fusers, or aligners in files as FILE.py:CLASS.
        only: rank the named methods alone, beside the references.

    Raises:
        InputError: a name is unknown.
    """
    if REFERENCE in methods:
        raise InputError(f"--method {REFERENCE}: smooths the logs, which a task set does not have")
    plug_ins = (entry.name for entry in entry_points(group=GROUP))
    fusers = [name for name in (*FUSERS, *plug_ins) if name != REFERENCE]
    aligners = [name for name in methods if name not in fusers]
    if only:
        named = [name for name in fusers if name in methods]
        fusers = list(dict.fromkeys([REFERENCE_FUSER, *named])) if named else []
        aligners = [REFERENCE_ALIGNER, *aligners] if aligners or not named else []
    else:
        defaults = {entry.method for entry in DEFAULT_ALIGNERS}
        others = (name for name in known_methods() if name not in defaults)
        aligners = [*(entry.name for entry in DEFAULT_ALIGNERS), *others, *aligners]
    entries = chosen_aligners(aligners, option="--method")
    _require_different([entry.name for entry in entries])
    return entries, tuple(fusers)


def _require_different(names: Sequence[str]) -> None:
    """Raise InputError if two methods have the same name, or one has that of the oracle."""
    for name in names:
        if name == ORACLE or names.count(name) > 1:
            raise InputError(
                f"{name}: is the name of another method too; rename your class or file"
            )


@dataclass(frozen=True)
class Leaderboard:
    """Results of all methods on a task set.

    Attributes:
        tasks: the task set.
        alignments: errors of the aligners (ALIGNMENTS).
        fusions: errors of the fusers (FUSIONS).
        origins: code of each method that is not ours: package, version and hash, or file.
    """

    tasks: TaskSet
    alignments: pd.DataFrame
    fusions: pd.DataFrame
    origins: Mapping[str, Any]

    @cached_property
    def aligners(self) -> pd.DataFrame:
        """Ranking of the aligners (ALIGNER_RANKS)."""
        return rank_aligners(self.alignments)

    @cached_property
    def fusers(self) -> pd.DataFrame:
        """Ranking of the fusers (FUSER_RANKS)."""
        return rank_fusers(self.fusions)


def stages_of_scenario(
    folder: str,
    digest: str,
    scenario: str,
    aligners: Sequence[AlignerEntry],
    fusers: Sequence[str],
) -> tuple[list[Stage], list[Stage]]:
    """Return the stages of the aligners and of the fusers on the tasks of one scenario."""
    of_aligners = []
    for entry in aligners:
        method = find_method(entry.method)
        cell = AlignerCell(folder, digest, scenario, **dict(entry), origin=method.origin())
        loads, writes = (method.own_module,), (_ALIGNMENTS_FILE,)
        of_aligners.append(Stage("leaderboard", _LABEL, cell, run_aligner, writes, loads=loads))
    of_fusers = []
    for name in fusers:
        cell = FuserCell(folder, digest, scenario, name, code_of_fuser(name))
        loads, writes = ("mapfusion.fusion",), (_FUSIONS_FILE,)
        of_fusers.append(Stage("leaderboard_fusion", _LABEL, cell, run_fuser, writes, loads=loads))
    return of_aligners, of_fusers


def run_leaderboard(
    tasks: TaskSet,
    aligners: Sequence[AlignerEntry],
    fusers: Sequence[str],
    estimates: Sequence[Path],
    store: Store,
    on_progress: OnProgress,
) -> Leaderboard:
    """Run all aligners and fusers on all tasks.

    Methods run one after the other in this process, plug-ins in one of their own, so that times can
    be compared. Finished results come from the store: a new method adds only its own.

    Args:
        tasks: the tasks.
        aligners: aligners to run.
        fusers: names of fusers to run.
        estimates: files of motions that were computed elsewhere, see `read_estimates`.
        store: store of the results.
        on_progress: called with the number of finished tasks.

    Raises:
        InputError: a file of estimates cannot be used.
    """
    _require_different([*(entry.name for entry in aligners), *(path.stem for path in estimates)])
    given = [read_estimates(path, tasks) for path in estimates]
    origins: dict[str, Any] = {path.stem: {"file": path.name} for path in estimates}
    origins |= {entry.name: find_method(entry.method).origin() for entry in aligners}
    alignments, fusions, ordered = list[Stage](), list[Stage](), list[Stage]()
    for scenario in tasks.scenarios:  # so that the maps of a scenario are read once
        of_set = str(tasks.folder.resolve()), tasks.digest
        of_aligners, of_fusers = stages_of_scenario(*of_set, scenario, aligners, fusers)
        alignments, fusions = alignments + of_aligners, fusions + of_fusers
        ordered += [*of_aligners, *of_fusers]
    with workers(1) as this_process:
        run_tasks(list(tasks_of(ordered, store).values()), this_process, on_progress)
    aligned = [read_rows(store.path(each) / _ALIGNMENTS_FILE, ALIGNMENTS) for each in alignments]
    fused = [read_rows(store.path(each) / _FUSIONS_FILE, FUSIONS) for each in fusions]
    rows, fusion_rows = (
        pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=pd.Index(names))
        for parts, names in (([*aligned, *given], ALIGNMENTS.names), (fused, FUSIONS.names))
    )
    # each aligner has its own copy of the oracle's rows
    rows = rows.drop_duplicates(["task", "aligner"], ignore_index=True)
    return Leaderboard(tasks, rows, fusion_rows, origins)


ESTIMATE_COLUMNS = ("task", *MOTION)


def read_estimates(path: Path, tasks: TaskSet) -> pd.DataFrame:
    """Return the errors (ALIGNMENTS) of motions T_a_b that were computed elsewhere.

    The file is a CSV table with the columns `task`, `tx_m`, `ty_m` and `theta_rad`. The covariance
    (`cov_xx`, `cov_xy`, `cov_xt`, `cov_yy`, `cov_yt`, `cov_tt`) and `accepted` (0 or 1) are
    optional. A task without a row has no estimate. Estimates are neither refined nor verified.

    Raises:
        InputError: a column is missing, or a cell cannot be used.
    """
    try:
        given = pd.read_csv(path, dtype={"task": str})
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as CSV ({one_line(str(error))})") from error
    if missing := [name for name in ESTIMATE_COLUMNS if name not in given]:
        needed = ", ".join(ESTIMATE_COLUMNS)
        raise InputError(f"{path}: has no column {', '.join(missing)}; needed are {needed}")
    unknown = given.loc[~given["task"].isin(tasks.tasks["task"]), "task"]
    if len(unknown):
        raise InputError(f"{path}: task {unknown.iloc[0]}: is not in {tasks.folder}/tasks.parquet")
    if given["task"].duplicated().any():
        twice = given.loc[given["task"].duplicated(), "task"].iloc[0]
        raise InputError(f"{path}: task {twice}: has two rows; give one")
    names = [*MOTION, *(name for name in (*COVARIANCE, "accepted") if name in given)]
    for name in names:
        if not pd.api.types.is_numeric_dtype(given[name]):
            raise InputError(f"{path}: {name}: is not a number in every row")
    if "accepted" in given and not given["accepted"].isin([0, 1]).all():
        raise InputError(f"{path}: accepted: is not 0 or 1 in every row")
    stated = [name for name in COVARIANCE if name in given]
    if stated and len(stated) < len(COVARIANCE):
        absent = ", ".join(name for name in COVARIANCE if name not in given)
        raise InputError(f"{path}: has no column {absent}; give all of the covariance, or none")
    if stated:
        known = given[given[stated].notna().all(axis=1)]
        least = np.linalg.eigvalsh(covariances_of(known)).min(axis=1, initial=np.inf)
        if len(wrong := known.loc[~(least > 0), "task"]):
            reason = "the covariance is not positive definite"
            raise InputError(f"{path}: task {wrong.iloc[0]}: {reason}; check units and signs")
    given_for = {row["task"]: row for row in given.to_dict("records")}
    parts = []
    for scenario in tasks.scenarios:
        for task in tasks_of_scenario(tasks.folder, tasks.digest, scenario):
            row = task.pair.keys | {"aligner": path.stem, "repetition": 0}
            row |= _given_row(len(task.pair.offered), given_for.get(task.name))
            rows = _errors_of(task, row)
            times = dict.fromkeys(("elapsed_s", "reference_s"), np.nan)
            parts.append(rows[rows["aligner"] != ORACLE].assign(**times))
    return pd.concat(parts, ignore_index=True)[ALIGNMENTS.names]


def _given_row(n_pairs: int, given: Mapping[Any, Any] | None) -> dict[str, Any]:
    """Return the row of `estimates` for a motion from a file; None for no motion."""
    T_a_b = np.array([given[name] for name in MOTION] if given else [np.nan] * 3, dtype=float)
    if given is None or not np.isfinite(T_a_b).all():
        missing = undetermined("no motion is given", n_pairs, time.perf_counter())
        return estimate_row(n_pairs, missing, missing, Verdict(missing.status, np.nan, ""))
    covariance = np.full((3, 3), np.nan)
    if COVARIANCE[0] in given:
        covariance = covariances_of(pd.DataFrame([given]))[0]
    inlier = np.zeros(n_pairs, dtype=bool)
    alignment = Alignment(T_a_b, covariance, inlier, np.nan, Status.ACCEPTED, "", np.nan, False)
    status = Status.ACCEPTED if given.get("accepted", 1) else Status.REFUSED
    return estimate_row(n_pairs, alignment, alignment, Verdict(status, np.nan, "as given"))


_SHARE = ("decisions", "decisions_low", "decisions_high")
_RATIOS = [f"{stage}_ratio{end}" for stage in STAGES for end in ("", "_low", "_high")]
_CALIBRATION = [
    f"{name}{end}" for name in ("nees_per_dof", "coverage_90") for end in ("", "_low", "_high")
]
# One row per aligner. decisions: share of right decisions with Wilson's interval, whose trials are
# runs; n_decided tasks count. false_merges: accepted alignments that are wrong or lack common
# ground. missed: right alignments that were not found or not accepted, of n_mergeable. Ratios:
# median error over the oracle's on the same maps, before and after refinement. nees_per_dof
# (median) and coverage_90: of accepted alignments whose covariance is complete. time_ratio: median
# time over the reference's. n_failed: exceptions, timeouts and invalid answers.
ALIGNER_RANKS = schema(
    "leaderboard.aligners",
    1,
    fields(
        rank=INT,
        aligner=TEXT,
        n_runs=INT,
        n_tasks=INT,
        n_decided=INT,
        **dict.fromkeys(_SHARE, FLOAT),
        false_merges=INT,
        missed=INT,
        n_mergeable=INT,
        **dict.fromkeys([*_RATIOS, *_CALIBRATION, "time_ratio"], FLOAT),
        n_failed=INT,
    ),
)


def rank_aligners(alignments: pd.DataFrame) -> pd.DataFrame:
    """Return one row per aligner, the best first (ALIGNER_RANKS)."""
    if alignments.empty:
        return pd.DataFrame(columns=pd.Index(ALIGNER_RANKS.names))
    rows = alignments[alignments["status"] != Status.ABSENT]
    maps, rng = summarise_alignments(rows), generator(SEED, "leaderboard")
    right = _right_decisions(rows)
    by_decisions, by_error = _more_right(right, methods_in(maps)), _smaller_errors(maps, rng)
    beats = by_decisions | {(a, b) for a, b in by_error if (b, a) not in by_decisions}
    ratios = oracle_ratios(maps, rng).set_index("aligner")
    nees = alignment_nees(rows, rng)
    nees = nees.set_index("aligner") if len(nees) else nees
    ranked = []
    for aligner in methods_in(maps):
        own, decided = rows[rows["aligner"] == aligner], right[right["aligner"] == aligner]
        to_merge = mergeable(own)
        merged = to_merge["accepted"] & right_refined(to_merge)
        share = float(decided["right"].mean())
        n = effective_trials(decided.groupby("run_id").size())
        low, high = map(float, wilson(share * n, n))
        row = {
            "rank": 1 + sum(worse == aligner for _, worse in beats),
            "aligner": aligner,
            "n_runs": own["run_id"].nunique(),
            "n_tasks": len(own),
            "n_decided": len(decided),
            **Interval(share, low, high).columns("decisions"),
            "false_merges": int(is_false_merge(own).sum()),
            "missed": int((~merged).sum()),
            "n_mergeable": len(to_merge),
            "time_ratio": float((own["elapsed_s"] / own["reference_s"]).median()),
            "n_failed": int((own["status"] == Status.FAILED).sum()),
        }
        row |= ratios.reindex([aligner])[_RATIOS].iloc[0].to_dict()
        row |= nees.reindex([aligner]).reindex(columns=_CALIBRATION).iloc[0].to_dict()
        ranked.append(row)
    by_rank = pd.DataFrame(ranked).sort_values(["rank", "estimated_ratio"], kind="stable")
    return by_rank[ALIGNER_RANKS.names].reset_index(drop=True)


def _right_decisions(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with a clear right decision, and whether it was made (`right`)."""
    rows = rows[rows["aligner"] != ORACLE]
    apart = ~has_common_ground(rows)
    to_merge = pd.Series(rows.index.isin(mergeable(rows).index), rows.index) & ~apart
    right = (rows["accepted"] & right_refined(rows)).where(to_merge, ~rows["accepted"])
    return rows.assign(right=right.astype(float))[apart | to_merge]


def _more_right(right: pd.DataFrame, aligners: Sequence[str]) -> set[tuple[str, str]]:
    """Return the pairs (better, worse) of aligners whose shares of right decisions differ."""
    if right.empty:
        return set()
    by_task = right.pivot_table(index=["run_id", "task"], columns="aligner", values="right")
    run_id, n_runs = by_task.index.get_level_values("run_id"), right["run_id"].nunique()
    pairs, tests = list(combinations(aligners, 2)), list[BetterTest]()
    for a, b in pairs:
        change = (by_task[b] - by_task[a]).to_numpy()
        tests.append(mean_change(change_of_each_run(change, run_id, n_runs, mean=True)))
    return _significant(pairs, np.array([test.p for test in tests]), [t.change for t in tests])


def _significant(
    pairs: Sequence[tuple[str, str]], p_values: Float, changes: Sequence[float]
) -> set[tuple[str, str]]:
    """Return the pairs (better, worse) whose change is significant; it is negative if a is better.

    The p values are corrected by Holm's method.
    """
    rows = zip(pairs, holm(p_values) < SIGNIFICANCE, changes, strict=True)
    return {(a, b) if change < 0 else (b, a) for (a, b), known, change in rows if known}


def _smaller_errors(maps: pd.DataFrame, rng: np.random.Generator) -> set[tuple[str, str]]:
    """Return the pairs (better, worse) of aligners whose errors before refinement differ."""
    compared = compare_methods(maps, rng)
    rows = compared[compared["p_holm"] < SIGNIFICANCE] if len(compared) else compared
    both = zip(rows["first"], rows["second"], rows["ratio"], strict=True) if len(rows) else ()
    return {(a, b) if ratio < 1 else (b, a) for a, b, ratio in both}


_OVER = [f"over_better_parent{end}" for end in ("", "_low", "_high")]
_RMSE = [f"landmark_rmse_m{end}" for end in ("", "_low", "_high")]
_NEES = [f"nees_per_dof{end}" for end in ("", "_low", "_high")]
# One row per fuser; medians over runs. landmark_rmse_m: in the frame of the first map.
# over_better_parent: error of common landmarks over that in the better of the two maps.
# nees_per_dof, coverage_95: of all landmarks with the gauge removed. duplicate_share: landmarks
# that are in the map twice. time_ratio: median time over the reference's.
FUSER_RANKS = schema(
    "leaderboard.fusers",
    1,
    fields(
        rank=INT,
        fuser=TEXT,
        n_runs=INT,
        **dict.fromkeys([*_RMSE, *_OVER, *_NEES], FLOAT),
        **dict.fromkeys(("coverage_95", "duplicate_share", "time_ratio"), FLOAT),
    ),
)


def rank_fusers(fusions: pd.DataFrame) -> pd.DataFrame:
    """Return one row per fuser, the best first (FUSER_RANKS)."""
    if fusions.empty:
        return pd.DataFrame(columns=pd.Index(FUSER_RANKS.names))
    rng = generator(SEED, "leaderboard")
    # a map with too many gross landmarks has no RMSE
    error = fusions.assign(error=fusions["landmark_rmse_m"].fillna(np.inf))
    by_run = error.pivot_table(index="run_id", columns="fuser", values="error", sort=False)
    fusers = list(dict.fromkeys(fusions["fuser"]))
    pairs = list(combinations(fusers, 2))
    changes = [log_ratio(by_run[a].to_numpy(), by_run[b].to_numpy()) for a, b in pairs]
    p = np.array([signed_rank(change) for change in changes])
    beats = _significant(pairs, p, [float(np.median(change)) for change in changes])
    ranked = []
    for fuser in fusers:
        own = error[error["fuser"] == fuser]
        clusters = clusters_of(own)
        row = {"rank": 1 + sum(worse == fuser for _, worse in beats), "fuser": fuser}
        row |= {"n_runs": own["run_id"].nunique()}
        for name, column in (
            ("landmark_rmse_m", "error"),
            ("over_better_parent", "over_better_parent"),
            ("nees_per_dof", "nees_per_dof"),
        ):
            row |= median_interval(own[column].to_numpy(), clusters, rng).columns(name)
        row |= own[["coverage_95", "duplicate_share"]].median().to_dict()
        row |= {"time_ratio": float((own["elapsed_s"] / own["reference_s"]).median())}
        ranked.append(row)
    by_rank = pd.DataFrame(ranked).sort_values(["rank", "landmark_rmse_m"], kind="stable")
    return by_rank[FUSER_RANKS.names].reset_index(drop=True)
