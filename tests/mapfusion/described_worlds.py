"""Maps and logs of made-up worlds whose landmarks have descriptors of several kinds."""

from dataclasses import replace

import numpy as np

import mapfusion
from mapfusion.descriptors import DescriptorKind
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from tests.mapfusion.align.map_pairs import landmarks

SIFT = DescriptorKind("euclidean", 128, "sift")
KINDS: dict[str, DescriptorKind] = {
    "sift": SIFT,
    "orb": DescriptorKind("hamming", 256, "orb"),
    "float256": DescriptorKind("euclidean", 256),
    "float768": DescriptorKind("cosine", 768),
}


def looks_of(kind: DescriptorKind, rng: np.random.Generator, n: int) -> np.ndarray:
    """Return descriptors of n landmarks as another program has them: uint8 if they are bits."""
    if kind.metric == "hamming":
        return rng.integers(0, 256, (n, kind.length // 8)).astype(np.uint8)
    scale = 80.0 if kind.name == "sift" else 3.0
    return np.abs(scale * rng.standard_normal((n, kind.length))).astype(np.float32)


def seen_again(looks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return descriptors with noise: 5 % of the bits differ, or numbers by 20 % of their spread."""
    if looks.dtype == np.uint8:
        bits = np.unpackbits(looks, axis=1)
        return np.packbits(bits ^ (rng.random(bits.shape) < 0.05), axis=1)
    noise = 0.2 * looks.std() * rng.standard_normal(looks.shape)
    return (looks + noise).astype(np.float32)


def two_maps(kind: DescriptorKind, seed: int = 0) -> tuple[LandmarkMap, LandmarkMap]:
    """Two maps of one hall, 40 of 60 landmarks in common; b is moved by (-2, -1) m."""
    rng = np.random.default_rng(seed)
    p, looks = rng.uniform(0, 20, (80, 3)) * [1, 1, 0], looks_of(kind, rng, 80)
    made = []
    for name, rows, shift in (("north", slice(60), 0), ("south", slice(20, 80), 1)):
        own = landmarks(p[rows] - shift * np.array([2, 1, 0]), 0.02, planar=True, name=name)
        noisy = own.position_m + rng.normal(0, 0.01, (60, 3)) * [1, 1, 0]
        look = seen_again(looks[rows], rng)
        made.append(replace(own, position_m=noisy, descriptor=look, descriptor_kind=kind))
    return made[0], made[1]


def log_of(kind: DescriptorKind, robot: str, start: list[float]) -> mapfusion.RobotLog:
    """A drive of 40 frames on a circle in a world of 150 landmarks, which all robots share."""
    world = np.random.default_rng(0)
    corners, looks = world.uniform([-4, -4, 0.2], [4, 4, 1.5], (150, 3)), looks_of(kind, world, 150)
    rng = np.random.default_rng(len(robot) + int(10 * start[1] + 100))
    pose, odometry, iteration, seen = np.array(start), [], [], []
    for frame in range(40):
        step = np.array([0.15, 0.0, 0.12]) if frame else np.zeros(3)
        pose = se2.compose(pose, step)
        odometry.append(step + rng.normal(0, 0.005, 3) * bool(frame))
        p = se2.transform_points(se2.inverse(pose), corners)
        ahead = np.flatnonzero((p[:, 0] > 0.3) & (np.hypot(*p[:, :2].T) < 3))
        iteration += [frame] * len(ahead)
        noise = rng.normal(0, [0.02, 0.01, 0.01], (len(ahead), 3))
        seen.append((p[ahead] + noise, seen_again(looks[ahead], rng)))
    observations = mapfusion.Observations(
        np.concatenate([position for position, _ in seen]),
        np.tile(np.diag([0.02, 0.01, 0.01]) ** 2, (len(iteration), 1, 1)),
        np.concatenate([look for _, look in seen]),
        descriptor_kind=kind,
    )
    times = 0.2 * np.arange(40)
    return mapfusion.RobotLog(
        robot, False, times, np.array(odometry), np.array(iteration), observations
    )
