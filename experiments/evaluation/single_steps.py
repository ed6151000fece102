"""Single steps on a user's files: slam, align, merge."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.evaluation.evaluated_run import JudgedRun, finding_of_truth
from experiments.pipeline.store import Store, link_or_copy, retry_damaged
from experiments.pipeline.tables import estimate_row
from experiments.pipeline.tasks import OnProgress
from experiments.plugins.discovery import callable_aligner
from experiments.scenario.seeds import generator
from experiments.scenario.settings import Align, AlignerEntry, AnyScenario, Recording, Scenario
from mapfusion.align.alignment import NOT_RUN, Pairs, Status
from mapfusion.align.correspondences import match
from mapfusion.attitude import read_attitude
from mapfusion.datasets.log_consistency import Finding, check_log, gate_finding, without_jumps
from mapfusion.errors import InputError
from mapfusion.fastslam.mapping import run_log
from mapfusion.files import Write, write_together
from mapfusion.fusion.fused_map import AlignedPair, Fusion, name_order
from mapfusion.fusion.fusers import make_fuser
from mapfusion.fusion.merge import merge as merge_maps
from mapfusion.fusion.team_graph import Place
from mapfusion.landmark_map import LandmarkMap, map_writes, read_map
from mapfusion.registration import Registration
from mapfusion.robot_log import read_log, read_odometry_covariance, read_true_poses


def require_simulation(scenario: AnyScenario) -> None:
    """Raise InputError for a scenario of recorded logs."""
    if isinstance(scenario, Recording):
        reason = "uses recorded logs, there is nothing to record"
        raise InputError(f"scenario {scenario.name}: {reason}")


def record(
    scenario: AnyScenario, output: Path, results: Path, jobs: int, on_progress: OnProgress
) -> list[Path]:
    """Simulate and write one log a robot into `output`; returns their folders."""
    require_simulation(scenario)
    run = JudgedRun.of(scenario, Store.of(results))

    def make() -> None:
        run.execute(jobs, on_progress, [robot.log for robot in run.pipeline.simulated])
        for robot in run.pipeline.robots:
            for path in sorted(run.store.path(robot.log).glob("*.parquet")):
                link_or_copy(path, output / robot.name / path.name)

    retry_damaged(run.store, make)
    return [output / robot.name for robot in run.pipeline.robots]


class MadeMap(NamedTuple):
    """Map of one robot's log.

    Attributes:
        landmarks: the most probable map at its end.
        findings: what the log says against itself.
    """

    landmarks: LandmarkMap
    findings: tuple[Finding, ...]

    @property
    def unusable(self) -> str:
        """Why nothing can be done with the map; empty where it can be used."""
        if not len(self.landmarks):
            return "the map is empty: no landmark was seen often enough where it was expected"
        gate = [finding.text for finding in self.findings if finding.kind == "gate"]
        return f"the map does not describe its log: {gate[0]}" if gate else ""


def slam(log: Path, settings: Scenario, on_progress: OnProgress) -> MadeMap:
    """The most probable map at the end of a log, by a scenario's `slam` section and seed."""
    robot_log = read_log(log)
    if not len(robot_log):
        raise InputError(f"{log}: frames.parquet holds no frame")
    n_frames, rng = len(robot_log), generator(settings.seed, "slam", robot_log.robot)
    found = check_log(robot_log, settings.slam.filter.motion)
    own = without_jumps(robot_log, found.jumps, read_odometry_covariance(log, n_frames))
    wanted, least, made = [n_frames - 1], settings.slam.min_count, None
    told = own[1], read_attitude(log, n_frames)
    for frame in run_log(own[0], settings.slam.filter, rng, wanted, least, *told):
        on_progress("FastSLAM", frame.iteration + 1, n_frames)
        made = frame
    assert made is not None
    assert made.landmarks is not None
    assert made.associations is not None
    gate = gate_finding(robot_log, made.associations)
    findings = [*found.findings, *([] if gate is None else [gate])]
    poses = read_true_poses(log)  # for this check alone, after the map is made
    if poses is not None and len(poses) == n_frames:
        sound = not any(finding.kind == "odometry" for finding in findings)
        truth = finding_of_truth(robot_log, poses, settings.slam.filter.motion, sound)
        findings += [] if truth is None else [truth]
    return MadeMap(made.landmarks, tuple(findings))


def save_map(path: Path, landmarks: LandmarkMap) -> None:
    """Write a map where the user wants it; raises InputError where that is impossible."""
    _save(path, map_writes(path, landmarks))


def _save(path: Path, writes: Mapping[Path, Write]) -> None:
    try:
        write_together(writes)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


# Why an alignment that is accepted by itself is not used.
_OF_THE_TEAM = {
    Place.UNCONFIRMED: "no other alignment confirms this one",
    Place.CONTRADICTED: "other alignments contradict this one",
    Place.AMBIGUOUS: "several motions fit, and other alignments do not tell which is right",
}


class Merged(NamedTuple):
    """Maps of the user's own made one.

    Attributes:
        fusion: what became of them.
        pairs: the alignments of each two of them, in the order of `fusion.place`; of ambiguous ones
            the alternatives, too.
    """

    fusion: Fusion
    pairs: list[AlignedPair]

    @property
    def any_merged(self) -> bool:
        """Return True if two maps or more were merged."""
        return len(self.fusion.fused[0].members) > 1

    def reasons(self) -> dict[tuple[int, int], str]:
        """Return why each two maps were not merged by their own alignment; empty if they were."""
        found: dict[tuple[int, int], str] = {}
        for pair, place in zip(self.pairs, self.fusion.place, strict=True):
            reason = pair.alignment.reason or _OF_THE_TEAM.get(place, "")
            if place in (Place.CONFIRMED, Place.BRIDGE):
                found[pair.a, pair.b] = ""
            else:
                found.setdefault((pair.a, pair.b), reason)
        return found


def numbered(path: Path, k: int) -> Path:
    """Return where the k-th of several fused maps goes: `path` itself, then `.2` and so on."""
    return path if k == 1 else path.with_stem(f"{path.stem}.{k}")


def save_fused(path: Path, merged: Merged) -> list[Path]:
    """Write the fused maps: that of the most maps to `path`, others beside it, from `.2` on.

    All are written or none. Where nothing was merged there is none.
    """
    if not merged.any_merged:
        return []
    fused = merged.fusion.fused
    paths = [numbered(path, k) for k in range(1, len(fused) + 1)]
    writes: dict[Path, Write] = {}
    for place, each in zip(paths, fused, strict=True):
        writes |= map_writes(place, each.landmarks)
    _save(path, writes)
    return paths


def _registration(entry: AlignerEntry, settings: Align) -> Registration:
    aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
    return Registration(aligner, settings.refinement, settings.judge)


def align(path_a: Path, path_b: Path, settings: Scenario) -> Iterator[dict[str, Any]]:
    """Yield every aligner's estimate, its refinement and the verdict on it, a row at a time.

    Each is called twice, with the same random numbers, and the second call is timed: the first
    compiles kernels and starts processes. Nothing of the first is kept for the second.
    """
    map_a, map_b = read_map(path_a), read_map(path_b)
    pairs = match(map_a, map_b, settings.align.match)
    evidence = settings.align.judge.on(Pairs(map_a, map_b, pairs)).evidence
    for entry in settings.align.aligners:
        registration = _registration(entry, settings.align)
        given = map_a, map_b, pairs, evidence
        done = registration.on(*given).register(generator(settings.seed, "align", entry.name))
        if done.estimated.status not in NOT_RUN:
            done = registration.on(*given).register(generator(settings.seed, "align", entry.name))
        row = {"aligner": entry.name, "elapsed_s": done.estimated.elapsed_s}
        row |= {"n_inliers": int(done.refined.inlier.sum())} | estimate_row(len(pairs), *done)
        yield row


def verdict_on(row: Mapping[str, Any]) -> tuple[Status, str]:
    """What became of an estimate (a row of `align`) in the end, and what is to be said of it."""
    status = Status(row["verdict"])
    if row["status"] in NOT_RUN:
        status = Status(row["status"])
    elif status is Status.DEGENERATE:
        status = Status.REFUSED
    return status, row["reason"] or row["refined_reason"] or row["acceptance_reason"]


def merge(paths: Sequence[Path], settings: Scenario) -> Merged:
    """Fuse maps by the alignments of each with each, a pair in the order of its robots' names."""
    if len(paths) < 2:
        raise InputError("merge: give two maps or more")
    name, entries = settings.merge.aligner, {each.name: each for each in settings.align.aligners}
    if name not in entries:
        raise InputError(f"merge.aligner: {name} is not among {', '.join(entries)}")
    maps = [read_map(path) for path in paths]
    registration, pairs = _registration(entries[name], settings.align), []
    order = sorted(range(len(maps)), key=lambda k: (name_order(maps[k].name), str(paths[k])))
    for a, b in itertools.combinations(order, 2):
        rng = generator(settings.seed, "align", name, maps[a].name, maps[b].name)
        offered = match(maps[a], maps[b], settings.align.match)
        ready = registration.on(maps[a], maps[b], offered)
        done = ready.register(rng)
        sureness = done.verdict.log10_false_alarms
        pairs.append(AlignedPair(a, b, done.applied, offered, sureness))
        if done.applied.status is Status.AMBIGUOUS and ready.judge is not None:
            rivals = ready.judge.rivals_of(done.refined)
            pairs += [AlignedPair(a, b, rival, offered, sureness) for rival in rivals]
    chosen = settings.merge
    fusion = merge_maps(maps, pairs, chosen.parameters, make_fuser(chosen.fuser))
    return Merged(fusion, pairs)
