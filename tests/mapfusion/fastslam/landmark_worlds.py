"""Small simulated worlds: landmarks, a robot path and measurements."""

from dataclasses import dataclass, replace

import numpy as np

from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.fastslam.proposal import Proposal
from mapfusion.geometry.se2 import compose, inverse, transform_points
from mapfusion.robot_log import Observations

SIGMA_M = 0.03
EXACT_MOTION = MotionNoise(0, 0, 0, 0, 0, lateral_m_per_sqrt_m=0, lateral_slip_m_per_rad=0)
LOOSE_MOTION = MotionNoise(
    0.1, 0.05, 0.1, 0, 0, lateral_m_per_sqrt_m=0.1, lateral_slip_m_per_rad=0.03
)


@dataclass
class World:
    landmarks: np.ndarray  # (L, 3) in the frame of the robot's start
    descriptor: np.ndarray  # (L, 64) unit vectors
    path: np.ndarray  # (T, 3) true poses
    odometry: list[np.ndarray]
    frames: list[Observations]
    seen: list[np.ndarray]  # rows of `landmarks` in each frame


def drive(
    seed: int,
    n_landmarks: int = 12,
    n_frames: int = 30,
    per_frame: int = 5,
    planar: bool = False,
    sigma_m: float = SIGMA_M,
    odometry_sigma: tuple[float, float, float] = (0.01, 0.01, 0.01),
) -> World:
    """Simulate a drive on a circle among random landmarks; each frame shows a few of them."""
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform([-2.0, -1.0, 0.0], [2.0, 4.0, 0.0 if planar else 1.5], (n_landmarks, 3))
    descriptor = unit(rng.standard_normal((n_landmarks, 64)))
    pose, path, odometry, frames, seen = np.zeros(3), [], [], [], []
    for frame in range(n_frames):
        motion = np.array([0.15, 0.0, 0.1]) if frame else np.zeros(3)
        pose = compose(pose, motion)
        noise = rng.normal(0, odometry_sigma) if frame else np.zeros(3)
        rows = np.sort(rng.choice(n_landmarks, min(per_frame, n_landmarks), replace=False))
        if frame % 7 == 6:
            rows = rows[:0]
        path.append(pose)
        odometry.append(motion + noise)
        frames.append(observe(pose, landmarks[rows], descriptor[rows], rows, rng, planar, sigma_m))
        seen.append(rows)
    return World(landmarks, descriptor, np.array(path), odometry, frames, seen)


def observe(pose, points, descriptor, label, rng, planar=False, sigma_m=SIGMA_M) -> Observations:
    """Observe points in the robot frame, with twice as much noise along x as along y."""
    n = len(points)
    sigma = np.array([2.0, 1.0, 0.0 if planar else 1.0]) * sigma_m
    covariance = np.diag(sigma**2)
    covariance[0, 1] = covariance[1, 0] = 0.5 * sigma[0] * sigma[1]
    if not planar:
        covariance[1, 2] = covariance[2, 1] = -0.3 * sigma[1] * sigma[2]
    root = np.linalg.cholesky(covariance + 1e-300 * np.eye(3))
    position = transform_points(inverse(pose), points) + rng.standard_normal((n, 3)) @ root.T
    noisy = unit(descriptor + 0.03 * rng.standard_normal((n, 64)))
    return Observations(
        position, np.tile(covariance, (n, 1, 1)), noisy.astype(np.float32), label.astype(np.int32)
    )


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def nothing() -> Observations:
    return Observations(np.empty((0, 3)), np.empty((0, 3, 3)))


def parameters(**changes) -> FastSlamParameters:
    """Return the settings of the paper's filter, with changes."""
    plain = FastSlamParameters(
        n_particles=15, motion=LOOSE_MOTION, proposal=Proposal.MOTION, close_loops=False
    )
    return replace(plain, **changes)
