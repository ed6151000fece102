"""The stages one by one, on files of the user's own."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.judge.judged_run import JudgedRun
from experiments.methods.aligner_calls import callable_aligner
from experiments.run.estimates import estimate_row
from experiments.run.store import Store, mending
from experiments.run.store_files import link_or_copy
from experiments.run.tasks import OnProgress
from experiments.scenario.loading import load_section
from experiments.scenario.randomness import generator
from experiments.scenario.settings import Align, AlignerEntry, AnyScenario, Merge, Recording, Slam
from mapfusion.align.correspondences import match
from mapfusion.align.registration import Registration
from mapfusion.errors import InputError
from mapfusion.fastslam.run import run_log
from mapfusion.landmark_map import LandmarkMap, read_map, write_map
from mapfusion.merge import FusedMap
from mapfusion.merge import merge as merge_maps
from mapfusion.robot_log import read_log


def record(
    scenario: AnyScenario, output: Path, results: Path, jobs: int, on_progress: OnProgress
) -> list[Path]:
    """Simulate and write one log a robot into `output`; returns their folders."""
    if isinstance(scenario, Recording):
        reason = "uses recorded logs, there is nothing to record"
        raise InputError(f"scenario {scenario.name}: {reason}")
    run = JudgedRun.of(scenario, Store.of(results))

    def make() -> None:
        run.execute(jobs, on_progress, [robot.log for robot in run.pipeline.simulated])
        for robot in run.pipeline.robots:
            for path in sorted(run.store.path(robot.log).glob("*.parquet")):
                link_or_copy(path, output / robot.name / path.name)

    mending(run.store, make)
    return [output / robot.name for robot in run.pipeline.robots]


def slam(
    log: Path, scenario: Path | None, overrides: Sequence[str], seed: int, on_progress: OnProgress
) -> LandmarkMap:
    """The most probable map at the end of a log, by the `slam` section of a scenario if given."""
    settings = load_section(scenario, "slam", Slam, overrides)
    robot_log = read_log(log)
    if not len(robot_log):
        raise InputError(f"{log}: frames.parquet holds no frame")
    n_frames, rng = len(robot_log), generator(seed, "slam", robot_log.robot)
    landmarks = None
    for frame in run_log(robot_log, settings.filter, rng, [n_frames - 1], settings.min_count):
        on_progress("FastSLAM", frame.iteration + 1, n_frames)
        landmarks = frame.landmarks
    assert landmarks is not None
    return landmarks


def save_map(path: Path, landmarks: LandmarkMap) -> None:
    """Write a map where the user wants it; raises InputError where that is impossible."""
    try:
        write_map(path, landmarks)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


def _registration(entry: AlignerEntry, settings: Align) -> Registration:
    aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
    return Registration(aligner, settings.refinement, settings.acceptance)


def align(
    paths: tuple[Path, Path], scenario: Path | None, overrides: Sequence[str], seed: int
) -> list[dict[str, Any]]:
    """Every aligner's estimate, its refinement and the verdict on it, as rows."""
    settings = load_section(scenario, "align", Align, overrides)
    map_a, map_b = map(read_map, paths)
    pairs = match(map_a, map_b, settings.match)
    rows = []
    for entry in settings.aligners:
        rng = generator(seed, "align", entry.name)
        done = _registration(entry, settings).register(map_a, map_b, pairs, rng)
        row = {"aligner": entry.name, "elapsed_s": done.estimated.elapsed_s}
        row |= {"n_inliers": int(done.refined.inlier.sum())} | estimate_row(len(pairs), *done)
        rows.append(row)
    return rows


def merge(
    paths: Sequence[Path], scenario: Path | None, overrides: Sequence[str], seed: int
) -> FusedMap:
    """Fuse maps in the frame of the first."""
    if len(paths) < 2:
        raise InputError("merge: give two maps or more")
    settings = load_section(scenario, "merge", Merge, overrides)
    align_section = load_section(scenario, "align", Align, ())
    entries = {entry.name: entry for entry in align_section.aligners}
    if settings.aligner not in entries:
        raise InputError(f"merge.aligner: {settings.aligner} is not among {', '.join(entries)}")
    first, *others = maps = [read_map(path) for path in paths]
    registration = _registration(entries[settings.aligner], align_section)
    offered, alignments = [], []
    for number, other in enumerate(others, start=1):
        rng = generator(seed, "align", settings.aligner, number)
        offered.append(match(first, other, align_section.match))
        alignments.append(registration.register(first, other, offered[-1], rng).applied)
    return merge_maps(maps, alignments, offered, settings.parameters)
