"""Stages that measure CPU time, memory and bytes to send of robots, of pairs and of a team.

The work is that of the stages `slam`, `smooth`, `aligner` and `fuse`. It is repeated in a process
of its own, after a first call that compiles and fills caches.
"""

import ctypes
import gc
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.pipeline.stage import Job
from experiments.pipeline.stages import fuse, smooth
from experiments.pipeline.stages.align import AlignerSettings
from experiments.pipeline.stages.fuse import FuseSettings
from experiments.pipeline.stages.slam import SlamSettings
from experiments.pipeline.stages.smooth import SmoothSettings, folders_of_both, latest_at, maps_of
from experiments.pipeline.tables import FLOAT, INT, TEXT, fields, read_rows, write_rows
from experiments.pipeline.workers import single_threaded
from experiments.plugins.discovery import callable_aligner
from mapfusion.align.correspondences import MatchParameters, match
from mapfusion.attitude import Attitude, read_attitude
from mapfusion.fastslam.mapping import run_log
from mapfusion.files import POSE_FIELDS, float_fields, named_columns, schema
from mapfusion.fusion.fusers import FusedMap
from mapfusion.geometry.numerics import Float, generator
from mapfusion.landmark_map import LandmarkMap, write_map
from mapfusion.robot_log import RobotLog, read_log, read_odometry_covariance, write_log
from mapfusion.verification.registration import Registration
from mapfusion.verification.verdict import Verifier

FILTER, SMOOTHING, ALIGNMENT, FUSION = "filter", "smoothing", "alignment", "fusion"
# Messages of a robot, as files in our own formats. A filter's map: landmarks with their own
# covariances and descriptors. A smoothed map: the same with the joint covariance of all landmarks.
# A log: odometry and all observations with their descriptors.
FILTER_MAP, SMOOTHED_MAP, LOG = "filter's map", "smoothed map", "log"

# One row per piece of work. Only this table differs from run to run.
WORK_COSTS = schema(
    "independence.work_costs", 1, fields(iteration=INT, work=TEXT, cpu_s=FLOAT, peak_mb=FLOAT)
)
SENT = schema("independence.sent", 1, fields(iteration=INT, what=TEXT, n_bytes=pa.int64()))
# A robot's poses as they were at an iteration: `frame` is the iteration of the pose.
PATHS = schema(
    "independence.paths",
    1,
    [*fields(iteration=INT, robot=TEXT, frame=INT), *float_fields(POSE_FIELDS)],
)
COSTS_FILE, SENT_FILE, PATHS_FILE = "costs.parquet", "sent.parquet", "paths.parquet"
ROBOT_WRITES = (COSTS_FILE, SENT_FILE, PATHS_FILE)
TEAM_WRITES = (*fuse.WRITES, COSTS_FILE, PATHS_FILE)

_STATUS, _PEAK_RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_RESET_PEAK = "5"  # begins a new peak of the resident memory, see proc(5)
_KB_A_MB = 1000.0  # the kernel's kB are 1024 bytes


@dataclass(frozen=True)
class Cost:
    """Cost of a piece of work.

    Attributes:
        cpu_s: CPU time of all threads, user and system.
        peak_mb: largest growth of the resident memory; NaN where the system does not report it.
    """

    cpu_s: float
    peak_mb: float


class Meter:
    """Meter of the CPU time and memory that were used since it was created.

    Memory is the kernel's high-water mark of this process (Linux) minus the resident memory at the
    start. So the inputs of the work do not count, and everything it allocates counts until it is
    freed. Python's own tracer would make the work several times slower.
    """

    def __init__(self) -> None:
        gc.collect(1)  # young objects only: a full collection takes longer than some work
        # Free memory that the C library holds must be returned, else work that uses it seems small.
        trim: Callable[[int], int] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:  # glibc only
            trim(0)
        try:
            _PEAK_RESET.write_text(_RESET_PEAK)
            self._at_start_kb = _status_kb("VmRSS")
        except OSError:
            self._at_start_kb = math.nan
        self._started_s = time.process_time()

    def read(self) -> Cost:
        """Return the cost so far."""
        cpu_s = time.process_time() - self._started_s
        return Cost(cpu_s, (_status_kb("VmHWM") - self._at_start_kb) * 1.024 / _KB_A_MB)


def cost_row(iteration: int, work: str, cost: Cost) -> dict[str, object]:
    """Return a row of `WORK_COSTS`."""
    return {"iteration": iteration, "work": work, "cpu_s": cost.cpu_s, "peak_mb": cost.peak_mb}


def _status_kb(name: str) -> float:
    """Return a value of /proc/self/status; NaN if there is none."""
    try:
        lines = _STATUS.read_text().splitlines()
    except OSError:
        return math.nan
    values = dict(line.split(":", 1) for line in lines)
    return float(values[name].split()[0]) if name in values else math.nan


@dataclass(frozen=True)
class RobotCostSettings:
    """Settings of the measured stages; the iterations are those of the smoother."""

    slam: SlamSettings
    smooth: SmoothSettings


def measure_robot(settings: RobotCostSettings, job: Job) -> None:
    """Write the costs of filter and smoother, the bytes to send, and the filter's paths."""
    single_threaded()
    log, iterations = read_log(job.inputs["log"]), settings.smooth.iterations
    folder = job.inputs["log"]
    extras = read_odometry_covariance(folder, len(log)), read_attitude(folder, len(log))
    _filter(settings.slam, log, extras, iterations[:1])  # compiles and fills caches
    _smooth_at(settings.smooth, job, log, iterations[0])
    filtered = _filter(settings.slam, log, extras, iterations)
    costs = [cost_row(each.iteration, FILTER, each.cost) for each in filtered]
    for k in iterations:
        costs.append(cost_row(k, SMOOTHING, _smooth_at(settings.smooth, job, log, k)))
    paths = [path_rows(each.iteration, log.robot, each.path) for each in filtered]
    sent, smoothed = [], job.inputs["smooth"]
    for each in filtered:  # the sizes of the files that would be sent
        k = each.iteration
        with tempfile.TemporaryDirectory() as place:
            own_map, own_log = Path(place) / "map", Path(place) / "log"
            write_map(own_map / "map.parquet", each.landmarks)
            write_log(own_log, smooth.log_until(log, k))
            # A robot whose log is not smoothed at this iteration sends the filter's map instead.
            has_map = k in smooth.read_smoothed_path(smoothed)
            messages = {
                FILTER_MAP: own_map.iterdir(),
                SMOOTHED_MAP: smooth.map_files(smoothed, k) if has_map else own_map.iterdir(),
                LOG: own_log.iterdir(),
            }
            for what, files in messages.items():
                n_bytes = sum(file.stat().st_size for file in files)
                sent.append({"iteration": k, "what": what, "n_bytes": n_bytes})
    write_rows(job.output / COSTS_FILE, WORK_COSTS, pd.DataFrame(costs))
    write_rows(job.output / SENT_FILE, SENT, pd.DataFrame(sent))
    write_rows(job.output / PATHS_FILE, PATHS, pd.concat(paths))


class _Filtered(NamedTuple):
    """Map and path of the filter at an iteration, and its cost since the first one."""

    iteration: int
    landmarks: LandmarkMap
    path: Float
    cost: Cost


def _filter(
    settings: SlamSettings,
    log: RobotLog,
    extras: tuple[Float | None, Attitude | None],
    iterations: Sequence[int],
) -> list[_Filtered]:
    """Run the filter over the log, as the stage `slam` does, up to the last iteration."""
    rng, found, meter = generator(settings.seed, "slam", log.robot), [], Meter()
    for frame in run_log(log, settings.filter, rng, iterations, settings.min_count, *extras):
        if frame.landmarks is not None:
            cost = meter.read()
            path = frame.slam.best_path()
            found.append(_Filtered(frame.iteration, frame.landmarks, path, cost))
        if frame.iteration == iterations[-1]:
            break
    return found


def _smooth_at(settings: SmoothSettings, job: Job, log: RobotLog, iteration: int) -> Cost:
    """Return the cost of smoothing the log up to an iteration, with the joint covariance."""
    given = smooth.smoother_inputs(job, log, iteration, settings.noise_floor_m)
    meter = Meter()
    smooth.smooth_log(settings, *given, read_attitude(job.inputs["log"]))
    return meter.read()


def path_rows(iteration: int, robot: str, path: Float) -> pd.DataFrame:
    """Return rows of `PATHS` of poses (T, 3) from the first frame on."""
    columns = named_columns(POSE_FIELDS, path) | {"frame": np.arange(len(path))}
    return pd.DataFrame(columns).assign(iteration=iteration, robot=robot)


def read_paths(folder: Path) -> dict[str, dict[int, Float]]:
    """Return poses (T, 3) by robot and iteration."""
    rows, found = read_rows(folder / PATHS_FILE, PATHS), dict[str, dict[int, Float]]()
    for (robot, k), own in rows.groupby(["robot", "iteration"], sort=False):
        found.setdefault(str(robot), {})[int(str(k))] = own[POSE_FIELDS].to_numpy()
    return found


@dataclass(frozen=True)
class PairCostSettings:
    """Settings of the measured stages, and the iterations at which maps are fused."""

    match: MatchParameters
    aligner: AlignerSettings
    iterations: tuple[int, ...]


def measure_pair(settings: PairCostSettings, job: Job) -> None:
    """Write the cost of aligning two maps at each iteration, with matching and acceptance."""
    single_threaded()
    smoothed = settings.aligner.smoothed
    maps_a, maps_b = (maps_of(each, smoothed=smoothed) for each in folders_of_both(job))
    both = {k: (latest_at(maps_a, k), latest_at(maps_b, k)) for k in settings.iterations}
    _align(settings, *both[settings.iterations[-1]])  # compiles and fills caches
    costs = [cost_row(k, ALIGNMENT, _align(settings, *maps)) for k, maps in both.items()]
    write_rows(job.output / COSTS_FILE, WORK_COSTS, costs)


def _align(settings: PairCostSettings, map_a: LandmarkMap, map_b: LandmarkMap) -> Cost:
    own = settings.aligner
    aligner = callable_aligner(own.method, own.parameters, own.time_limit_s)
    registration = Registration(
        aligner, own.refinement, Verifier(own.acceptance, own.evidence, own.refinement)
    )
    rng, meter = generator(own.seed, "align", map_a.name, map_b.name), Meter()
    pairs = match(map_a, map_b, settings.match)
    registration.on(map_a, map_b, pairs).register(rng)
    return meter.read()


def measure_team(settings: FuseSettings, job: Job) -> None:
    """Fuse with one fuser at each iteration; write maps as the stage `fuse` does, and costs.

    Paths are written where the fuser estimates them anew, in the fused frame.
    """
    single_threaded()
    fusions: dict[int, Sequence[FusedMap]] = {}
    costs, paths, warm = [], list[pd.DataFrame](), set[bool]()
    for k, given in fuse.given_teams(settings, job):
        connected = given.connected(settings)
        merged = len(connected.components[0].members) > 1
        if merged not in warm:
            given.fused(connected, settings)  # compiles and fills caches
            warm.add(merged)
        meter = Meter()
        fusions[k] = given.fused(given.connected(settings), settings)
        costs.append(cost_row(k, FUSION, meter.read()))
        first = fusions[k][0]
        for place, path in zip(first.members, first.paths, strict=False):
            paths.append(path_rows(k, settings.robots[place], path))
    fuse.write_fusions(job.output, fusions, settings.robots)
    write_rows(job.output / COSTS_FILE, WORK_COSTS, pd.DataFrame(costs))
    write_rows(job.output / PATHS_FILE, PATHS, pd.concat(paths) if paths else [])
