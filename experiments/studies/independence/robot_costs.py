"""Stage: what a robot's own work costs, filter and smoother, and how much it has to send.

The work is that of the stages `slam` and `smooth`, done again by itself and warmed.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.pipeline.stage import Job
from experiments.pipeline.stages import smooth
from experiments.pipeline.stages.slam import SlamSettings
from experiments.pipeline.stages.smooth import SmoothSettings
from experiments.pipeline.tables import INT, TEXT, fields, read_rows, write_rows
from experiments.pipeline.workers import single_threaded
from experiments.scenario.seeds import generator
from experiments.studies.independence.measured_work import (
    COSTS_FILE,
    WORK_COSTS,
    Cost,
    Meter,
    cost_row,
)
from experiments.studies.independence.strategies import FILTER_MAP, LOG, SMOOTHED_MAP
from mapfusion.attitude import Attitude, read_attitude
from mapfusion.fastslam.mapping import run_log
from mapfusion.files import POSE_FIELDS, float_fields, named_columns, schema
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap, write_map
from mapfusion.robot_log import RobotLog, read_log, read_odometry_covariance, write_log

LABEL = "measure the robots' work"
FILTER, SMOOTHING = "filter", "smoothing"
SENT = schema("independence.sent", 1, fields(iteration=INT, what=TEXT, n_bytes=pa.int64()))
# A robot's poses as they were at an iteration: `frame` is the iteration of the pose.
PATHS = schema(
    "independence.paths",
    1,
    [*fields(iteration=INT, robot=TEXT, frame=INT), *float_fields(POSE_FIELDS)],
)
SENT_FILE, PATHS_FILE = "sent.parquet", "paths.parquet"
WRITES = (COSTS_FILE, SENT_FILE, PATHS_FILE)


@dataclass(frozen=True)
class RobotCostSettings:
    """Those of the stages whose work it is; the iterations are the smoother's."""

    slam: SlamSettings
    smooth: SmoothSettings


def run(settings: RobotCostSettings, job: Job) -> None:
    """Write costs, bytes to send and, at each iteration, the filter's path."""
    single_threaded()
    log, iterations = read_log(job.inputs["log"]), settings.smooth.iterations
    folder = job.inputs["log"]
    told = read_odometry_covariance(folder, len(log)), read_attitude(folder, len(log))
    _filter(settings.slam, log, told, iterations[:1])  # compiles, and fills caches
    _smooth_at(settings.smooth, job, log, iterations[0])
    filtered = _filter(settings.slam, log, told, iterations)
    costs = [cost_row(each.iteration, FILTER, each.cost) for each in filtered]
    for k in iterations:
        costs.append(cost_row(k, SMOOTHING, _smooth_at(settings.smooth, job, log, k)))
    paths = [path_rows(each.iteration, log.robot, each.path) for each in filtered]
    sent = [row for each in filtered for row in _sent(each, log, job.inputs["smooth"])]
    write_rows(job.output / COSTS_FILE, WORK_COSTS, pd.DataFrame(costs))
    write_rows(job.output / SENT_FILE, SENT, pd.DataFrame(sent))
    write_rows(job.output / PATHS_FILE, PATHS, pd.concat(paths))


class _Filtered(NamedTuple):
    """What the filter has made at an iteration, and spent from the first on."""

    iteration: int
    landmarks: LandmarkMap
    path: Float
    cost: Cost


def _filter(
    settings: SlamSettings,
    log: RobotLog,
    told: tuple[Float | None, Attitude | None],
    iterations: Sequence[int],
) -> list[_Filtered]:
    """The filter over the log, as the stage `slam` runs it, up to the last of the iterations."""
    rng, found, meter = generator(settings.seed, "slam", log.robot), [], Meter()
    for frame in run_log(log, settings.filter, rng, iterations, settings.min_count, *told):
        if frame.landmarks is not None:
            cost = meter.read()
            path = frame.slam.best_path()
            found.append(_Filtered(frame.iteration, frame.landmarks, path, cost))
        if frame.iteration == iterations[-1]:
            break
    return found


def _smooth_at(settings: SmoothSettings, job: Job, log: RobotLog, iteration: int) -> Cost:
    """What smoothing the log up to an iteration takes, with the condensing of its covariance."""
    given = smooth.filtered_until(job, log, iteration, settings.noise_floor_m)
    meter = Meter()
    smooth.smoothed_anew(settings, *given, read_attitude(job.inputs["log"]))
    return meter.read()


def _sent(filtered: _Filtered, log: RobotLog, smoothed: Path) -> Iterator[dict[str, Any]]:
    """Rows of `SENT` at an iteration: the sizes of the files that would be sent.

    A robot whose log is not smoothed until then sends the filter's map instead.
    """
    k = filtered.iteration
    with tempfile.TemporaryDirectory() as place:
        own_map, own_log = Path(place) / "map", Path(place) / "log"
        write_map(own_map / "map.parquet", filtered.landmarks)
        write_log(own_log, smooth.log_until(log, k))
        has_map = k in smooth.read_smoothed_path(smoothed)
        files = {
            FILTER_MAP: own_map.iterdir(),
            SMOOTHED_MAP: smooth.map_files(smoothed, k) if has_map else own_map.iterdir(),
            LOG: own_log.iterdir(),
        }
        for what, own in files.items():
            n_bytes = sum(file.stat().st_size for file in own)
            yield {"iteration": k, "what": what, "n_bytes": n_bytes}


def path_rows(iteration: int, robot: str, path: Float) -> pd.DataFrame:
    """Rows of `PATHS` of poses (T, 3) from the first frame on."""
    columns = named_columns(POSE_FIELDS, path) | {"frame": np.arange(len(path))}
    return pd.DataFrame(columns).assign(iteration=iteration, robot=robot)


def read_paths(folder: Path) -> dict[str, dict[int, Float]]:
    """Poses (T, 3) by robot and iteration."""
    rows, found = read_rows(folder / PATHS_FILE, PATHS), dict[str, dict[int, Float]]()
    for (robot, k), own in rows.groupby(["robot", "iteration"], sort=False):
        found.setdefault(str(robot), {})[int(str(k))] = own[POSE_FIELDS].to_numpy()
    return found
