"""Single steps on a user's files: record, export as a dataset, slam, align, merge, calibrate."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.evaluation.evaluated_run import EvaluatedRun, finding_of_truth
from experiments.pipeline.stage import Stage
from experiments.pipeline.stages.align import estimate_row
from experiments.pipeline.stages.features import render_frame
from experiments.pipeline.stages.log import measured_odometry, measured_tilt
from experiments.pipeline.stages.pipeline import SimulatedRobotStages, smoother_parameters
from experiments.pipeline.stages.slam import checked_log
from experiments.pipeline.stages.smooth import SmoothSettings, log_until, smooth_log
from experiments.pipeline.store import Store, link_or_copy, retry_damaged
from experiments.pipeline.tasks import OnProgress
from experiments.plugins.discovery import callable_aligner
from experiments.scenario.settings import Align, AlignerEntry, AnyScenario, Recording, Scenario
from mapfusion.align.alignment import NOT_RUN
from mapfusion.align.correspondences import match
from mapfusion.attitude import FILE as ATTITUDE_FILE
from mapfusion.attitude import read_attitude
from mapfusion.datasets.formats import EXPORTERS, export_drive
from mapfusion.datasets.log_consistency import Finding, gate_finding
from mapfusion.datasets.stereo_recording import StereoDrive
from mapfusion.errors import InputError
from mapfusion.fastslam.mapping import run_log
from mapfusion.files import write_all_atomically
from mapfusion.fusion.map_merging import MapAlignment, MergedMaps, align_maps, load_maps, merge_maps
from mapfusion.geometry.numerics import Float, generator
from mapfusion.landmark_map import LandmarkMap, map_writes
from mapfusion.robot_log import (
    TRUTH_FILES,
    read_log,
    read_odometry_covariance,
    read_true_poses,
    write_log,
)
from mapfusion.smoother.noise_estimation import NOISE_PARAMETERS
from mapfusion.smoother.odometry_calibration import Calibration, calibrate
from mapfusion.smoother.smooth import SmootherParameters, with_path_errors
from mapfusion.tables import NO_LABEL
from mapfusion.verification.registration import Registration
from mapfusion.vision.depth import DepthParameters, add_noise
from sim.rendering.frame_source import FrameSource
from sim.stereo_head import StereoFrame
from sim.trajectory import TRAJECTORY_FILE, Trajectory, read_trajectory


def require_simulation(scenario: AnyScenario) -> None:
    """Raise InputError for a scenario of recorded logs."""
    if isinstance(scenario, Recording):
        reason = "uses recorded logs, there is nothing to record"
        raise InputError(f"scenario {scenario.name}: {reason}")


def record(
    scenario: AnyScenario, output: Path, results: Path, jobs: int, on_progress: OnProgress
) -> list[Path]:
    """Simulate, and write the log of each robot into `output`; return the folders of the logs."""
    require_simulation(scenario)
    run = EvaluatedRun.of(scenario, Store.of(results))

    def make() -> None:
        run.execute(jobs, on_progress, [robot.log for robot in run.pipeline.simulated])
        for robot in run.pipeline.robots:
            for path in sorted(run.store.path(robot.log).glob("*.parquet")):
                link_or_copy(path, output / robot.name / path.name)

    retry_damaged(run.store, make)
    return [output / robot.name for robot in run.pipeline.robots]


class SlamResult(NamedTuple):
    """Map of one robot's log.

    Attributes:
        landmarks: map of the most probable particle at the end; with the joint covariance of its
            errors if the log was smoothed.
        findings: contradictions in the log.
        smoothed: map of the batch smoother; None if the log was not smoothed.
        not_smoothed: reason why the log could not be smoothed; else empty.
    """

    landmarks: LandmarkMap
    findings: tuple[Finding, ...]
    smoothed: LandmarkMap | None = None
    not_smoothed: str = ""

    @property
    def unusable(self) -> str:
        """Reason why the map cannot be used; empty if it can."""
        if not len(self.landmarks):
            return "the map is empty: no landmark was seen often enough where it was expected"
        gate = [finding.text for finding in self.findings if finding.kind == "gate"]
        return f"the map does not describe its log: {gate[0]}" if gate else ""


def slam(
    log: Path, settings: Scenario, on_progress: OnProgress, smoothing: bool = True
) -> SlamResult:
    """Map the log of a robot with the sections `slam` and `smooth` and the seed of a scenario.

    Args:
        log: folder of the log.
        settings: the scenario.
        on_progress: called with the number of finished frames.
        smoothing: also smooth the log.

    Raises:
        InputError: the log cannot be read or has no frame.
    """
    robot_log = read_log(log)
    if not len(robot_log):
        raise InputError(f"{log}: frames.parquet holds no frame")
    n_frames, rng = len(robot_log), generator(settings.seed, "slam", robot_log.robot)
    known, stated = read_odometry_covariance(log, n_frames), settings.slam.filter
    checked = checked_log(robot_log, known, stated, settings.slam.noise)
    used_log, covariance = checked.log, checked.odometry_covariance
    kept, min_count, last = [n_frames - 1], settings.slam.min_count, None
    attitude, parameters = read_attitude(log, n_frames), replace(stated, motion=checked.motion)
    for frame in run_log(used_log, parameters, rng, kept, min_count, covariance, attitude):
        on_progress("FastSLAM", frame.iteration + 1, n_frames)
        last = frame
    assert last is not None
    assert last.landmarks is not None
    assert last.associations is not None
    gate = gate_finding(robot_log, last.associations)
    findings = [*checked.findings, *([] if gate is None else [gate])]
    poses = read_true_poses(log)  # only for this check, after the map is complete
    if poses is not None and len(poses) == n_frames:
        sound = not any(finding.kind == "odometry" for finding in findings)
        truth = finding_of_truth(robot_log, poses, checked.motion, sound)
        findings += [] if truth is None else [truth]
    if not smoothing or not len(last.landmarks):
        return SlamResult(last.landmarks, tuple(findings))
    assert last.path is not None
    smoother = smoother_parameters(settings)
    own = SmoothSettings(
        replace(smoother, motion=checked.motion, odometry_covariance=covariance),
        parameters.noise_floor_m,
        (n_frames - 1,),
        settings.smooth.max_memory_gb,
    )
    given = log_until(used_log, n_frames - 1, parameters.noise_floor_m)
    on_progress("smooth the log", 0, 1)
    smoothed, *_, ended = smooth_log(own, given, last.associations, last.path, attitude)
    on_progress("smooth the log", 1, 1)
    landmarks = last.landmarks
    if smoothed is not None:
        landmarks = with_path_errors(landmarks, smoothed)
    return SlamResult(landmarks, tuple(findings), smoothed, str(ended[-1]))


def save_maps(path: Path, made: SlamResult) -> list[Path]:
    """Write the filter's map and, beside it, the smoothed map; return the paths.

    Raises:
        InputError: a file cannot be written.
    """
    paths, writes = [path], map_writes(path, made.landmarks)
    if made.smoothed is not None:
        paths.append(path.with_name(f"{path.stem}.smoothed{path.suffix}"))
        writes |= map_writes(paths[-1], made.smoothed)
    try:
        write_all_atomically(writes)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error
    return paths


def save_fused(path: Path, merged: MergedMaps) -> list[Path]:
    """Write the fused maps, if maps were merged; raise InputError if a file cannot be written."""
    if not merged.any_merged:
        return []
    try:
        return merged.write(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


def _registration(entry: AlignerEntry, settings: Align) -> Registration:
    aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
    return Registration(aligner, settings.refinement, settings.verifier)


def align(
    path_a: Path,
    path_b: Path,
    settings: Scenario,
    sigma_m: float | None = None,
    descriptor_metric: str = "",
) -> Iterator[MapAlignment]:
    """Yield for each aligner the alignment of two maps.

    `sigma_m` is the standard deviation of landmarks of maps without covariances,
    `descriptor_metric` the metric of descriptors that state none.

    Each aligner is called twice with the same random numbers, and the second call is timed. The
    first call compiles kernels and starts processes.

    Raises:
        InputError: a map cannot be read.
    """
    map_a, map_b = load_maps({"a": path_a, "b": path_b}, sigma_m, descriptor_metric)
    pairs = match(map_a, map_b, settings.align.match)
    evidence = None
    for entry in settings.align.aligners:
        registration = _registration(entry, settings.align)
        for _ in range(2):
            found = align_maps(
                map_a,
                map_b,
                aligner=registration,
                name=entry.name,
                matching=settings.align.match,
                correspondences=pairs,
                evidence=evidence,
                rng=generator(settings.seed, "align", entry.name),
            )
            verifier = found.ready.verifier
            evidence = None if verifier is None else verifier.evidence
            if found.registered.estimated.status in NOT_RUN:
                break
        yield found


def alignment_row(found: MapAlignment) -> dict[str, Any]:
    """Return an alignment as a row: estimate, refinement, verdict, time and inliers."""
    row = {"aligner": found.aligner, "elapsed_s": found.registered.estimated.elapsed_s}
    row |= {"n_inliers": int(found.inlier.sum())}
    row |= estimate_row(len(found.correspondences), *found.registered)
    refined = found.registered.refined
    return row | {"overlap": refined.overlap, "heights": refined.heights}


def merge(
    paths: Sequence[Path],
    settings: Scenario,
    sigma_m: float | None = None,
    descriptor_metric: str = "",
) -> MergedMaps:
    """Align all pairs of maps and fuse the maps.

    `sigma_m` is the standard deviation of landmarks of maps without covariances,
    `descriptor_metric` the metric of descriptors that state none.

    Raises:
        InputError: there are fewer than two maps, a map cannot be read, or the aligner is unknown.
    """
    name, entries = settings.merge.aligner, {each.name: each for each in settings.align.aligners}
    if name not in entries:
        raise InputError(f"merge.aligner: {name} is not among {', '.join(entries)}")
    return merge_maps(
        paths,
        aligner=_registration(entries[name], settings.align),
        name=name,
        matching=settings.align.match,
        fuser=settings.merge.fuser,
        parameters=settings.merge.parameters,
        sigma_m=sigma_m,
        descriptor_metric=descriptor_metric,
        rng=lambda a, b: generator(settings.seed, "align", name, a.name, b.name),
    )


def write_drives(
    scenario: AnyScenario,
    format_name: str,
    output: Path,
    results: Path,
    jobs: int,
    on_progress: OnProgress,
) -> list[Path]:
    """Simulate, and write images, odometry and truth of each robot as a dataset.

    Args:
        scenario: the simulation.
        format_name: name of the dataset format.
        output: folder of the datasets.
        results: folder of the store.
        jobs: number of processes.
        on_progress: called with the number of finished tasks and frames.

    Returns:
        The paths that `mapfusion import` reads.

    Raises:
        InputError: the format is unknown, or the scenario is a recording.
    """
    if format_name not in EXPORTERS:
        known = ", ".join(["log", *EXPORTERS])
        raise InputError(f"--format {format_name}: unknown; known: {known}")
    require_simulation(scenario)
    run = EvaluatedRun.of(scenario, Store.of(results))
    robots = run.pipeline.simulated
    drive, faces = (robots[0].features.before[name] for name in ("drive", "faces"))
    assert isinstance(drive, Stage)
    assert isinstance(faces, Stage)
    retry_damaged(run.store, lambda: run.execute(jobs, on_progress, [drive, faces]))
    trajectory = read_trajectory(run.store.path(drive) / TRAJECTORY_FILE)
    settings = robots[0].features.settings  # all robots have the same camera and renderer
    world = (run.store.path(faces), settings.camera, trajectory.robots, settings.renderer)
    written = []
    with FrameSource(*world) as source:
        for robot in robots:
            label = f"{robot.name}: write {format_name}"
            dataset = _stereo_drive(robot, trajectory, source)
            show = functools.partial(on_progress, label)
            written += export_drive(format_name, output, dataset, show)
    return written


def _stereo_drive(
    robot: SimulatedRobotStages, trajectory: Trajectory, source: FrameSource
) -> StereoDrive:
    @functools.lru_cache(maxsize=1)  # some formats write pictures and depths
    def frame(k: int) -> StereoFrame:
        return render_frame(robot.features.settings, source, trajectory.bodies(k), k)

    def depth_m(k: int) -> np.ndarray:
        rng = generator(robot.features.settings.seed, "depth", robot.name, k)
        return add_noise(frame(k).depth_m, DepthParameters().sigma_per_m, rng)

    index, tilts = trajectory.index(robot.name), trajectory.tilt_rad
    return StereoDrive(
        robot.name,
        robot.features.settings.camera,
        trajectory.time_s,
        trajectory.T_world_robot[index],
        measured_odometry(robot.log.settings, trajectory),
        lambda k: (frame(k).left, frame(k).right),
        None if tilts is None else tilts[index],
        measured_tilt(robot.observed.settings, trajectory),
        depth_m,
    )


def calibrate_logs(
    logs: Sequence[Path], output: Path | None, settings: Scenario, on_progress: OnProgress
) -> Calibration:
    """Calibrate the odometry of logs, and write corrected logs.

    Landmarks are identified by labels if all observations have one, else by FastSLAM with the
    settings of the scenario. The truth is copied, but not read.

    Args:
        logs: folders of logs, one for each robot.
        output: folder of the corrected logs; None writes nothing.
        settings: settings of the filter and of the smoother.
        on_progress: called with the number of finished frames and steps.

    Raises:
        InputError: a log cannot be read or calibrated, or a corrected log cannot be written.
    """
    loaded = [read_log(path) for path in logs]
    names = [log.robot for log in loaded]
    for path, name in zip(logs, names, strict=True):
        if names.count(name) > 1:
            raise InputError(f"{path}: robot {name} has more than one log here")
        inputs = {each.resolve() for each in logs}
        for written in () if output is None else (output, output / name):
            if written.resolve() in inputs:
                raise InputError(f"--output {output}: {written} is an input; name another folder")
    landmarks, paths = [], list[Float | None]()
    for log in loaded:
        label, frame = log.observations.label, None
        if label is not None and not np.any(label == NO_LABEL):
            landmarks.append(label.astype(np.int64))
            paths.append(None)
            continue
        rng = generator(settings.seed, "slam", log.robot)
        for frame in run_log(log, settings.slam.filter, rng):
            on_progress(f"FastSLAM of {log.robot}", frame.iteration + 1, len(log))
        if frame is None:
            raise InputError(f"log {log.robot}: holds no frame")
        landmarks.append(frame.slam.best_associations())
        paths.append(frame.slam.best_path())
    parameters = SmootherParameters(
        stray_m=settings.smooth.stray_m, min_count=settings.slam.min_count
    )
    calibration = calibrate(
        loaded,
        landmarks,
        paths,
        parameters,
        lambda done, most: on_progress("calibrate", done, most),
    )
    if output is not None:
        for source, log, robot in zip(logs, loaded, calibration.robots, strict=True):
            folder = output / log.robot
            try:
                write_log(folder, replace(log, odometry=robot.error.corrected(log.odometry)))
                for name in (*TRUTH_FILES, ATTITUDE_FILE):
                    (folder / name).unlink(missing_ok=True)
                    if (source / name).exists():
                        link_or_copy(source / name, folder / name)
            except OSError as error:
                raise InputError(f"{folder}: cannot be written ({error.strerror})") from error
    return calibration


def filter_settings(calibration: Calibration) -> dict[str, Any]:
    """Return the section `slam.filter.motion` of a scenario for corrected logs."""
    motion = {name: float(f"{value:.3g}") for name, value in asdict(calibration.motion).items()}
    wanted = {
        *NOISE_PARAMETERS,
        "scale_error",
        "track_error",
        "lateral_m_per_sqrt_m",
        "lateral_slip_m_per_rad",
    }
    return {"slam": {"filter": {"motion": {k: v for k, v in motion.items() if k in wanted}}}}
