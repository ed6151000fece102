"""Odometry calibration of a user's logs, and logs with corrected odometry."""

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
from mapfusion.smoother.noise_estimation import NOISE_PARAMETERS
from mapfusion.smoother.odometry_calibration import Calibration, calibrate
from mapfusion.smoother.smooth import SmootherParameters
from mapfusion.tables import NO_LABEL


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
        on_progress: is told of finished frames and steps.

    Raises:
        InputError: a log cannot be read or calibrated, or a corrected log cannot be written.
    """
    loaded = [read_log(path) for path in logs]
    names = [log.robot for log in loaded]
    for path, name in zip(logs, names, strict=True):
        if names.count(name) > 1:
            raise InputError(f"{path}: robot {name} has more than one log here")
    associations = [_associations(log, settings, on_progress) for log in loaded]
    parameters = SmootherParameters(
        stray_m=settings.smooth.stray_m, min_count=settings.slam.min_count
    )
    calibration = calibrate(
        loaded,
        [landmark for landmark, _ in associations],
        [path for _, path in associations],
        parameters,
        lambda done, most: on_progress("calibrate", done, most),
    )
    if output is not None:
        for source, log, robot in zip(logs, loaded, calibration.robots, strict=True):
            folder = output / log.robot
            try:
                write_log(folder, robot.error.corrected_log(log))
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


def _associations(
    log: RobotLog, settings: Scenario, on_progress: OnProgress
) -> tuple[np.ndarray, Float | None]:
    """Return the landmark of each observation, shape (N,), and FastSLAM's path, shape (T, 3).

    The path is None if all observations have a label.
    """
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
