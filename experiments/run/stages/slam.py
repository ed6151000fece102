"""Stage: one robot's FastSLAM over its log, with its map at each evaluated iteration."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.run.job import Job
from experiments.scenario.randomness import generator
from mapfusion.fastslam.filter import StepResult
from mapfusion.fastslam.parameters import FastSlamParameters
from mapfusion.fastslam.run import run_log
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog, read_log
from mapfusion.storage import (
    column,
    point_columns,
    point_fields,
    points_from,
    read_table,
    schema,
    write_table,
)

SNAPSHOTS = schema(
    "slam.snapshots",
    1,
    [
        pa.field("iteration", pa.int32()),
        *point_fields(),
        pa.field("count", pa.int32()),
        pa.field("source_observation", pa.int64()),
    ],
)
# From this iteration on, the observation counts for the landmark that came from source_observation
# (-1: for none). Only changes are listed.
ASSOCIATIONS = schema(
    "slam.associations",
    1,
    [
        pa.field("from_iteration", pa.int32()),
        pa.field("observation", pa.int32()),
        pa.field("source_observation", pa.int32()),
    ],
)
POSES = schema(
    "slam.poses",
    1,
    [
        pa.field("iteration", pa.int32()),
        *(
            pa.field(f"{source}_{name}", pa.float64())
            for source in ("online", "final")
            for name in ("x_m", "y_m", "theta_rad")
        ),
        pa.field("effective_sample_size", pa.float64()),
        pa.field("resampled", pa.bool_()),
        pa.field("n_landmarks", pa.int32()),
        pa.field("spread_m", pa.float64()),
    ],
)
CLOUDS = schema(
    "slam.clouds",
    1,
    [
        pa.field("iteration", pa.int32()),
        pa.field("particle", pa.int32()),
        *(pa.field(name, pa.float64()) for name in ("x_m", "y_m", "theta_rad", "log_weight")),
    ],
)


WRITES = ("snapshots.parquet", "associations.parquet", "poses.parquet", "clouds.parquet")


@dataclass(frozen=True)
class SlamSettings:
    """All that a robot's maps depend on, beside its log."""

    seed: int
    filter: FastSlamParameters
    min_count: int
    every: int
    clouds_every: int


class RobotFolders(NamedTuple):
    """Where a robot's log (with its truth) and its SLAM result lie."""

    log: Path
    slam: Path


def evaluated_iterations(n_frames: int, every: int) -> list[int]:
    """Each multiple of `every` from the first on, and the last frame."""
    return sorted({*range(every, n_frames, every), n_frames - 1})


def run(settings: SlamSettings, job: Job) -> None:
    """Run the filter over a log and write maps, poses, associations and particle clouds."""
    log = read_log(job.inputs["log"])
    last = len(log) - 1
    recorder = _Recorder()
    iterations = evaluated_iterations(len(log), settings.every)
    rng = generator(settings.seed, "slam", log.robot)
    for frame in run_log(log, settings.filter, rng, iterations, settings.min_count):
        result = frame.result
        recorder.add_step(frame.iteration, result)
        if frame.iteration % settings.clouds_every == 0 or frame.iteration == last:
            recorder.clouds.append((frame.iteration, result.cloud, result.log_weights))
        if frame.landmarks is not None:
            recorder.add_snapshot(frame.iteration, frame.landmarks, frame.slam.best_associations())
        if frame.iteration == last:
            recorder.write(job.output, frame.slam.best_path())


class _Recorder:
    """Collects what a filter tells along the way."""

    def __init__(self) -> None:
        self.maps: list[tuple[int, LandmarkMap]] = []
        self.associations: list[pd.DataFrame] = []
        self.steps: list[dict[str, float]] = []
        self.clouds: list[tuple[int, np.ndarray, np.ndarray]] = []
        self._known = np.empty(0, dtype=np.int64)

    def add_step(self, iteration: int, result: StepResult) -> None:
        self.steps.append(
            {
                "iteration": iteration,
                "online_x_m": result.best_pose[0],
                "online_y_m": result.best_pose[1],
                "online_theta_rad": result.best_pose[2],
                "effective_sample_size": result.effective_sample_size,
                "resampled": result.resampled,
                "n_landmarks": result.n_landmarks,
                "spread_m": spread_m(result.cloud, result.log_weights),
            }
        )

    def add_snapshot(
        self, iteration: int, landmarks: LandmarkMap, associations: np.ndarray
    ) -> None:
        self.maps.append((iteration, landmarks))
        known = np.full(len(associations), -1, dtype=np.int64)
        known[: len(self._known)] = self._known
        changed = np.flatnonzero(known != associations)
        self.associations.append(
            pd.DataFrame(
                {
                    "from_iteration": np.full(len(changed), iteration),
                    "observation": changed,
                    "source_observation": associations[changed],
                }
            )
        )
        self._known = associations

    def write(self, folder: Path, final_path: np.ndarray) -> None:
        poses = pd.DataFrame(self.steps)
        for i, name in enumerate(("x_m", "y_m", "theta_rad")):
            poses[f"final_{name}"] = final_path[: len(poses), i]
        write_table(folder / "poses.parquet", dict(poses.items()), POSES)
        write_table(
            folder / "associations.parquet",
            dict(pd.concat(self.associations, ignore_index=True).items()),
            ASSOCIATIONS,
        )
        # An empty map has no row: the list tells that its iteration was evaluated all the same.
        iterations = ",".join(str(iteration) for iteration, _ in self.maps)
        columns = _snapshot_columns(self.maps)
        write_table(folder / "snapshots.parquet", columns, SNAPSHOTS, {"iterations": iterations})
        write_table(folder / "clouds.parquet", _cloud_columns(self.clouds), CLOUDS)


def spread_m(cloud: np.ndarray, log_weights: np.ndarray) -> float:
    """Root of the trace of the weighted position covariance of particles (M, 3)."""
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    centred = cloud[:, :2] - weights @ cloud[:, :2]
    return float(np.sqrt(weights @ np.sum(centred**2, axis=1)))


def _snapshot_columns(maps: list[tuple[int, LandmarkMap]]) -> dict[str, np.ndarray]:
    return {
        "iteration": np.concatenate([np.full(len(m), iteration) for iteration, m in maps]),
        **point_columns(
            np.concatenate([m.position_m for _, m in maps]),
            np.concatenate([m.covariance_m2 for _, m in maps]),
        ),
        "count": np.concatenate([m.count for _, m in maps]),
        "source_observation": np.concatenate([m.source_observation for _, m in maps]),
    }


def _cloud_columns(clouds: list[tuple[int, np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    poses = np.concatenate([cloud for _, cloud, _ in clouds])
    return {
        "iteration": np.concatenate([np.full(len(cloud), i) for i, cloud, _ in clouds]),
        "particle": np.concatenate([np.arange(len(cloud)) for _, cloud, _ in clouds]),
        "x_m": poses[:, 0],
        "y_m": poses[:, 1],
        "theta_rad": poses[:, 2],
        "log_weight": np.concatenate([weights for _, _, weights in clouds]),
    }


def read_snapshots(slam: Path, log: RobotLog) -> dict[int, LandmarkMap]:
    """The robot's map at each evaluated iteration, with descriptors and labels from its log."""
    table, attributes = read_table(slam / "snapshots.parquet", SNAPSHOTS)
    position, covariance = points_from(table)
    iteration = column(table, "iteration")
    count, source = column(table, "count"), column(table, "source_observation")
    maps = {}
    for k in map(int, attributes["iterations"].split(",")):
        rows = slice(*np.searchsorted(iteration, [k, k + 1]))
        origin = source[rows]
        descriptor, label = log.observations.descriptor, log.observations.label
        maps[k] = LandmarkMap(
            position[rows],
            covariance[rows],
            count[rows],
            origin,
            None if descriptor is None else descriptor[origin],
            None if label is None else label[origin],
            log.planar,
            log.robot,
        )
    return maps


def read_associations(slam: Path) -> pd.DataFrame:
    """Changes of which landmark each observation counts for, in order of iteration."""
    table, _ = read_table(slam / "associations.parquet", ASSOCIATIONS)
    return table.to_pandas()
