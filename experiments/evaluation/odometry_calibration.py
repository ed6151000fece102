"""Odometry calibration of a user's logs, and corrected logs."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from experiments.pipeline.store import link_or_copy
from experiments.pipeline.tasks import OnProgress
from experiments.scenario.seeds import generator
from experiments.scenario.settings import Scenario
from mapfusion.attitude import FILE as ATTITUDE_FILE
from mapfusion.errors import InputError
from mapfusion.fastslam.mapping import run_log
from mapfusion.geometry.numerics import Float
from mapfusion.robot_log import TRUTH_FILES, RobotLog, read_log, write_log
from mapfusion.smoother.noise_estimation import LEVELS
from mapfusion.smoother.odometry_calibration import Calibration, calibrate
from mapfusion.smoother.smooth import SmootherParameters
from mapfusion.tables import NO_LABEL


def calibrate_logs(
    logs: Sequence[Path], output: Path | None, settings: Scenario, on_progress: OnProgress
) -> Calibration:
    """Calibrate logs, one a robot; write them with corrected odometry into `output`, if given.

    Landmarks are told apart by labels where all observations have them, else by FastSLAM with the
    scenario's settings. The truth, where there is one, is passed on unread.

    Raises:
        InputError: a log cannot be read or calibrated.
    """
    known = [read_log(path) for path in logs]
    names = [log.robot for log in known]
    for path, name in zip(logs, names, strict=True):
        if names.count(name) > 1:
            raise InputError(f"{path}: robot {name} has more than one log here")
    found = [_associations(log, settings, on_progress) for log in known]
    parameters = SmootherParameters(
        stray_m=settings.smooth.stray_m, min_count=settings.slam.min_count
    )
    calibration = calibrate(
        known,
        [landmark for landmark, _ in found],
        [path for _, path in found],
        parameters,
        lambda done, most: on_progress("calibrate", done, most),
    )
    if output is not None:
        for source, log, robot in zip(logs, known, calibration.robots, strict=True):
            _write(output / log.robot, robot.error.corrected_log(log), source)
    return calibration


def filter_settings(calibration: Calibration) -> dict[str, Any]:
    """The scenario's section for corrected logs: `slam.filter.motion`."""
    motion = {name: float(f"{value:.3g}") for name, value in asdict(calibration.motion).items()}
    wanted = {
        *LEVELS,
        "scale_error",
        "track_error",
        "lateral_m_per_sqrt_m",
        "lateral_slip_m_per_rad",
    }
    return {"slam": {"filter": {"motion": {k: v for k, v in motion.items() if k in wanted}}}}


def _associations(
    log: RobotLog, settings: Scenario, on_progress: OnProgress
) -> tuple[np.ndarray, Float | None]:
    """Which landmark each observation (N,) is of, and a path (T, 3) where labels do not say."""
    label = log.observations.label
    if label is not None and not np.any(label == NO_LABEL):
        return label.astype(np.int64), None
    frame = None
    rng = generator(settings.seed, "slam", log.robot)
    for frame in run_log(log, settings.slam.filter, rng):
        on_progress(f"FastSLAM of {log.robot}", frame.iteration + 1, len(log))
    if frame is None:
        raise InputError(f"log {log.robot}: holds no frame")
    return frame.slam.best_associations(), frame.slam.best_path()


def _write(folder: Path, log: RobotLog, source: Path) -> None:
    try:
        write_log(folder, log)
        for name in (*TRUTH_FILES, ATTITUDE_FILE):
            (folder / name).unlink(missing_ok=True)
            if (source / name).exists():
                link_or_copy(source / name, folder / name)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from error
