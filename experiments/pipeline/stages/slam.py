"""Stage: FastSLAM of one robot over its log, with its map at each evaluated iteration."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.pipeline.stage import Job, StageKind
from experiments.pipeline.tables import BOOL, FLOAT, INT, TEXT, fields, read_rows
from mapfusion.attitude import read_attitude
from mapfusion.datasets.log_consistency import (
    Finding,
    Jump,
    NoiseSource,
    check_log,
    gate_finding,
    without_jumps,
)
from mapfusion.datasets.odometry_direction import DirectionError
from mapfusion.datasets.relative_motion import MIN_MOTIONS
from mapfusion.fastslam.filter import FastSlamParameters, StepResult
from mapfusion.fastslam.mapping import association_for, run_log
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.files import (
    POSE_FIELDS,
    column,
    columns,
    covariance_columns,
    covariances_from,
    float_fields,
    named_columns,
    point_columns,
    point_fields,
    read_table,
    schema,
    write_table,
)
from mapfusion.geometry.numerics import Float, generator
from mapfusion.robot_log import RobotLog, read_log, read_odometry_covariance

_ONLINE, _FINAL = ([f"{path}_{name}" for name in POSE_FIELDS] for path in ("online", "final"))
_ITERATION = fields(iteration=INT)
_SOURCES = fields(count=INT, source_observation=pa.int64())
SNAPSHOTS = schema("slam.snapshots", 1, [*_ITERATION, *point_fields(), *_SOURCES])
# From this iteration on, the observation is assigned to the landmark that was created by
# source_observation (-1: to none). The table lists changes only.
ASSOCIATIONS = schema(
    "slam.associations", 1, fields(from_iteration=INT, observation=INT, source_observation=INT)
)
_STEP = fields(effective_sample_size=FLOAT, resampled=BOOL, n_landmarks=INT, spread_m=FLOAT)
POSES = schema("slam.poses", 1, [*_ITERATION, *float_fields(_ONLINE + _FINAL), *_STEP])
_PARTICLE = fields(iteration=INT, particle=INT)
CLOUDS = schema("slam.clouds", 1, [*_PARTICLE, *float_fields([*POSE_FIELDS, "log_weight"])])
# Inconsistencies of a log (mapfusion.datasets.log_consistency), one per row: the iteration of a
# jump or -1, and for jumps the motion that the observations imply in place of the odometry.
_OBSERVED = [f"observed_{name}" for name in POSE_FIELDS]
_OBSERVED_COVARIANCE = ["cov_xx", "cov_xy", "cov_xt", "cov_yy", "cov_yt", "cov_tt"]
FINDINGS = schema(
    "slam.findings",
    1,
    [
        *fields(check=TEXT, iteration=INT, finding=TEXT),
        *float_fields([*_OBSERVED, *_OBSERVED_COVARIANCE]),
    ],
)
# Path of the most probable particle at each evaluated iteration, from which its map was computed.
PATHS = schema("slam.paths", 1, [*fields(evaluated=INT), *_ITERATION, *float_fields(POSE_FIELDS)])

WRITES = (
    "snapshots.parquet",
    "associations.parquet",
    "poses.parquet",
    "clouds.parquet",
    "paths.parquet",
    "findings.parquet",
)


@dataclass(frozen=True)
class SlamSettings:
    """Settings of a robot's maps, in addition to its log."""

    seed: int
    filter: FastSlamParameters
    noise: NoiseSource
    min_count: int
    every: int
    clouds_every: int


def evaluated_iterations(n_frames: int, every: int) -> list[int]:
    """Return each positive multiple of `every` and the last frame."""
    return sorted({*range(every, n_frames, every), n_frames - 1})


def run(settings: SlamSettings, job: Job) -> None:
    """Run the filter over a log and write maps, poses, associations and particle clouds."""
    recorded = read_log(job.inputs["log"])
    known = read_odometry_covariance(job.inputs["log"], len(recorded))
    checked = checked_log(recorded, known, settings.filter, settings.noise)
    log, parameters = checked.log, replace(settings.filter, motion=checked.motion)
    last = len(log) - 1
    steps = list[dict[str, float]]()
    maps, associations, clouds, paths = _Rows(), _Rows(), _Rows(), _Rows()
    counted = np.empty(0, dtype=np.int64)
    iterations = evaluated_iterations(len(log), settings.every)
    rng = generator(settings.seed, "slam", log.robot)
    measured = checked.odometry_covariance, read_attitude(job.inputs["log"], len(log))
    filtered = run_log(
        log, parameters, rng, iterations, settings.min_count, *measured, viewing=False
    )
    for frame in filtered:
        k, result = frame.iteration, frame.result
        steps.append(_step(result))
        if k % settings.clouds_every == 0 or k == last:
            cloud = {"particle": np.arange(len(result.cloud)), "log_weight": result.log_weights}
            clouds.add(named_columns(POSE_FIELDS, result.cloud) | cloud, iteration=k)
        if frame.landmarks is not None:
            assert frame.path is not None
            assert frame.associations is not None
            seen, origin = frame.landmarks, frame.landmarks.source_observation
            points = point_columns(seen.position_m, seen.covariance_m2)
            maps.add(points | {"count": seen.count, "source_observation": origin}, iteration=k)
            counts_for = frame.associations
            new = np.full(len(counts_for) - len(counted), -1)
            changed = np.flatnonzero(counts_for != np.concatenate([counted, new]))
            changes = {"observation": changed, "source_observation": counts_for[changed]}
            associations.add(changes, from_iteration=k)
            counted, path = counts_for, frame.path
            rows = {"iteration": np.arange(len(path))} | named_columns(POSE_FIELDS, path)
            paths.add(rows, evaluated=k)
    poses = {name: np.array([step[name] for step in steps]) for name in steps[0]}
    poses |= {"iteration": np.arange(len(steps))} | named_columns(_FINAL, path)
    # The list includes iterations with an empty map, which has no row.
    evaluated = {"iterations": ",".join(map(str, iterations))}
    tables = (maps.columns, associations.columns, poses, clouds.columns, paths.columns)
    schemas = (SNAPSHOTS, ASSOCIATIONS, POSES, CLOUDS, PATHS)
    for file, table_schema, rows in zip(WRITES[:-1], schemas, tables, strict=True):
        write_table(job.output / file, rows, table_schema, evaluated)
    gate = gate_finding(log, counted)
    findings = checked.findings if gate is None else (*checked.findings, gate)
    write_findings(job.output, checked._replace(findings=findings))


SLAM_STAGE = StageKind("slam", "FastSLAM", run, WRITES)


class CheckedLog(NamedTuple):
    """Input of the filter and of the smoother, after the checks of a log.

    Attributes:
        log: log without jumps and without the systematic error of the odometry's direction.
        odometry_covariance: covariance of its odometry, shape (T, 3, 3); None: the motion noise.
        noise_factor: factor of the motion noise over the stated one.
        motion: motion noise.
        findings: findings about the log.
        jumps: increments of the odometry that are not used.
        direction: systematic error of the odometry's direction.
    """

    log: RobotLog
    odometry_covariance: Float | None
    noise_factor: float
    motion: MotionNoise
    findings: tuple[Finding, ...]
    jumps: tuple[Jump, ...]
    direction: DirectionError


def checked_log(
    log: RobotLog,
    odometry_covariance: Float | None,
    stated: FastSlamParameters,
    source: NoiseSource,
) -> CheckedLog:
    """Check a log, correct its odometry, and choose the motion noise.

    The findings also name an association that differs from the stated one.

    Args:
        log: recorded log.
        odometry_covariance: covariance of visual odometry, shape (T, 3, 3), whose noise is not
            estimated; else None.
        stated: stated settings of the filter.
        source: source of the motion noise.
    """
    found, factor = check_log(log, stated.motion), 1.0
    findings, noise = found.findings, found.noise
    if odometry_covariance is not None or any(each.kind == "odometry" for each in findings):
        pass  # the noise is that of the observations, or the odometry has another mistake
    elif noise.is_larger:
        used = "the filter uses the stated noise (slam.noise: from_log uses the larger one)"
        if source is NoiseSource.FROM_LOG:
            factor = noise.factor
            used = "the filter uses the larger noise (slam.noise: stated keeps slam.filter.motion)"
        findings = (*findings, Finding("noise", -1, f"{noise.text}; {used}"))
    elif found.unchecked and len(log) > MIN_MOTIONS:
        used = "the filter uses the noise of slam.filter.motion"
        findings = (*findings, Finding("noise", -1, f"{found.unchecked}; {used}"))
    corrected = replace(log, odometry=found.direction.corrected(log.odometry))
    used_log, covariance = without_jumps(corrected, found.jumps, odometry_covariance)
    used = association_for(log, stated.association)
    if used is not stated.association:
        text = f"observations have no {stated.association}: they are associated by {used}"
        findings = (*findings, Finding("association", -1, f"{text} (slam.filter.association)"))
    motion = stated.motion.scaled(factor)
    return CheckedLog(used_log, covariance, factor, motion, findings, found.jumps, found.direction)


def write_findings(slam: Path, checked: CheckedLog) -> None:
    """Write the findings about a robot's log, with the observed motion of jumps.

    The factor of the motion noise over the stated one and the systematic error of the odometry's
    direction are attributes of the table.
    """
    findings = checked.findings
    observed = np.full((len(findings), 3), np.nan)
    covariance = np.full((len(findings), 3, 3), np.nan)
    row = {finding.frame: n for n, finding in enumerate(findings) if finding.kind == "jump"}
    for jump in checked.jumps:
        observed[row[jump.frame]], covariance[row[jump.frame]] = jump.observed, jump.covariance
    rows = {
        "check": [finding.kind for finding in findings],
        "iteration": np.array([finding.frame for finding in findings], dtype=np.int32),
        "finding": [finding.text for finding in findings],
        **named_columns(_OBSERVED, observed),
        **covariance_columns(_OBSERVED_COVARIANCE, covariance),
    }
    numbers = {"noise_factor": checked.noise_factor, **checked.direction._asdict()}
    attributes = {name: repr(float(value)) for name, value in numbers.items()}
    write_table(slam / WRITES[-1], rows, FINDINGS, attributes)


def read_findings(slam: Path) -> pd.DataFrame:
    """Read the findings about a robot's log."""
    return read_rows(slam / WRITES[-1], FINDINGS)


def noise_factor(slam: Path) -> float:
    """Return the factor of the filter's motion noise over the stated one."""
    _, attributes = read_table(slam / WRITES[-1], FINDINGS)
    return float(attributes["noise_factor"])


def log_as_filtered(log: Path, slam: Path) -> tuple[RobotLog, Float | None]:
    """Return the filter's input log, as corrected, and its odometry covariance if known."""
    table, attributes = read_table(slam / WRITES[-1], FINDINGS)
    recorded = read_log(log)
    direction = DirectionError(
        *(float(attributes.get(name, "0")) for name in DirectionError._fields)
    )
    recorded = replace(recorded, odometry=direction.corrected(recorded.odometry))
    observed, covariance = columns(table, _OBSERVED), covariances_from(table, _OBSERVED_COVARIANCE)
    jumps = [
        Jump(int(k), observed[n], covariance[n], recorded.odometry[k])
        for n, k in enumerate(column(table, "iteration"))
        if k >= 0
    ]
    return without_jumps(recorded, jumps, read_odometry_covariance(log))


class _Rows:
    """Rows of a table, collected in parts."""

    def __init__(self) -> None:
        self._parts = list[Mapping[str, np.ndarray]]()

    def add(self, columns: Mapping[str, np.ndarray], **same: int) -> None:
        """Add rows by column, with further columns of constant values."""
        n = len(next(iter(columns.values())))
        self._parts.append(
            dict(columns) | {name: np.full(n, value) for name, value in same.items()}
        )

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """All rows by column."""
        return {
            name: np.concatenate([part[name] for part in self._parts]) for name in self._parts[0]
        }


def _step(result: StepResult) -> dict[str, float]:
    """Return the row of one filter step in the table of poses."""
    weights = np.exp(result.log_weights - result.log_weights.max())
    weights /= weights.sum()
    centred = result.cloud[:, :2] - weights @ result.cloud[:, :2]
    return {
        **dict(zip(_ONLINE, result.best_pose, strict=True)),
        "effective_sample_size": result.effective_sample_size,
        "resampled": result.resampled,
        "n_landmarks": result.n_landmarks,
        # root of the trace of the particles' weighted position covariance
        "spread_m": float(np.sqrt(weights @ np.sum(centred**2, axis=1))),
    }


def final_path(slam: Path) -> Float:
    """Read the final path of the most probable particle, shape (T, 3)."""
    return read_rows(slam / "poses.parquet", POSES)[_FINAL].to_numpy(np.float64)


class Associations:
    """Landmark of each observation, as C changes between evaluated iterations.

    Attributes:
        from_iteration: iteration of each change, ascending, shape (C,).
        observation: row of the log, shape (C,).
        source: observation that created the landmark, -1 for none, shape (C,).
    """

    def __init__(
        self, from_iteration: np.ndarray, observation: np.ndarray, source: np.ndarray
    ) -> None:
        order = np.argsort(from_iteration, kind="stable")
        self.from_iteration = from_iteration[order]
        self.observation, self.source = observation[order], source[order]

    @classmethod
    def read(cls, slam: Path) -> "Associations":
        """Read the associations from the stage's folder."""
        table, _ = read_table(slam / "associations.parquet", ASSOCIATIONS)
        names = ("from_iteration", "observation", "source_observation")
        return cls(*(column(table, name) for name in names))

    def at(self, iteration: int, n_observations: int) -> np.ndarray:
        """Return the source of the log's first observations at an iteration, int64."""
        counts_for = np.full(n_observations, -1, dtype=np.int64)
        so_far = slice(np.searchsorted(self.from_iteration, iteration, side="right"))
        # the last change of an observation applies
        counts_for[self.observation[so_far]] = self.source[so_far]
        return counts_for
