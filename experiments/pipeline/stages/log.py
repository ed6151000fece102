"""Stage: log of one robot from its observations and noisy odometry, with the truth beside it."""

from dataclasses import dataclass

from experiments.pipeline.stage import Job
from experiments.pipeline.stages.drive import TRAJECTORY_FILE
from experiments.pipeline.store import link_or_copy
from experiments.scenario.seeds import generator
from mapfusion.attitude import FILE as ATTITUDE_FILE
from mapfusion.geometry.numerics import Float
from mapfusion.robot_log import write_frames, write_truth_poses
from sim.odometry import OdometryNoise, add_noise, calibrated_track_m, encoder_increments
from sim.trajectory import Trajectory, read_trajectory

LABEL = "track features"
_OBSERVED = ("observations.parquet", "truth_points.parquet")
WRITES = ("frames.parquet", *_OBSERVED, "truth_poses.parquet")


@dataclass(frozen=True)
class LogSettings:
    """Settings of a robot's log, in addition to trajectory and observations."""

    seed: int
    robot: str
    odometry: OdometryNoise


def run(settings: LogSettings, job: Job) -> None:
    """Write odometry, observations and truth to the folder of the log."""
    trajectory = read_trajectory(job.inputs["drive"] / TRAJECTORY_FILE)
    index = trajectory.index(settings.robot)
    odometry = measured_odometry(settings, trajectory)
    write_frames(job.output, settings.robot, False, trajectory.time_s, odometry)
    for name in _OBSERVED:
        link_or_copy(job.inputs["observed"] / name, job.output / name)
    attitude = job.inputs["observed"] / ATTITUDE_FILE
    if attitude.exists():  # for a body that sways
        link_or_copy(attitude, job.output / ATTITUDE_FILE)
    write_truth_poses(job.output, trajectory.T_world_robot[index])


def measured_odometry(settings: LogSettings, trajectory: Trajectory) -> Float:
    """Return the noisy wheel odometry of a robot as increments, shape (T, 3)."""
    wheel_rad = trajectory.wheel_rad[trajectory.index(settings.robot)]
    rng = generator(settings.seed, "odometry", settings.robot)
    increments = encoder_increments(wheel_rad, calibrated_track_m())
    return add_noise(increments, settings.odometry, rng)
