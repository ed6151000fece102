"""Maps with viewing evidence of known walls, observed by robots that drive along a line."""

import numpy as np

from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import Observations, RobotLog
from mapfusion.viewing import viewing_of_log

HALF_VIEW_RAD, FARTHEST_M = 0.45, 8.0


class Wall:
    """Wall along x at y = 3 with landmarks: positions (N, 3) and descriptors.

    Each of `copies` (first_x, width, at_x) repeats an interval of x elsewhere. With `niches` every
    second metre lies a metre deeper.
    """

    def __init__(
        self, length_m: float, seed: int, copies=(), per_m: int = 12, niches: bool = False
    ) -> None:
        rng = np.random.default_rng(seed)
        n = int(length_m * per_m)
        self.p = np.stack(
            [rng.uniform(0, length_m, n), np.full(n, 3.0), rng.uniform(0.1, 1.2, n)], axis=1
        )
        self.p[:, 1] += niches * (np.floor(self.p[:, 0]) % 2)
        look = rng.standard_normal((n, 64))
        self.look = look / np.linalg.norm(look, axis=1, keepdims=True)
        for first, width, at in copies:
            self._hang(first, width, at)

    def _hang(self, first: float, width: float, at: float) -> None:
        inside = (self.p[:, 0] >= first) & (self.p[:, 0] < first + width)
        hidden = (self.p[:, 0] >= at) & (self.p[:, 0] < at + width)
        copy = self.p[inside] + [at - first, 0, 0]
        self.p = np.concatenate([self.p[~hidden], copy])
        self.look = np.concatenate([self.look[~hidden], self.look[inside]])


def mapped(
    wall: Wall,
    first_x: float,
    last_x: float,
    seed: int,
    name: str = "R1",
    noise_m: float = 0.01,
    step_m: float = 0.125,
) -> LandmarkMap:
    """Return the map of a robot that drives along the wall, in the frame of its start.

    The camera faces the wall at a distance of 3 m.
    """
    rng = np.random.default_rng(seed)
    x = np.arange(first_x, last_x, step_m)
    path_world = np.stack([x, np.zeros(len(x)), np.full(len(x), np.pi / 2)], axis=1)
    T_world_map = path_world[0]
    path = se2.between(T_world_map, path_world)
    p_map = wall.p.copy()
    p_map[:, :2] = se2.transform_points(se2.inverse(T_world_map), p_map[:, :2])
    frame, row, seen = [], [], []
    for t, pose in enumerate(path):
        p = p_map.copy()
        p[:, :2] = se2.transform_points(se2.inverse(pose), p[:, :2])
        bearing, range_m = np.arctan2(p[:, 1], p[:, 0]), np.hypot(p[:, 0], p[:, 1])
        view = (np.abs(bearing) < HALF_VIEW_RAD) & (range_m < FARTHEST_M)
        frame += [t] * int(view.sum())
        row += np.flatnonzero(view).tolist()
        seen.append(p[view])
    position = np.concatenate(seen)
    n, owner_row = len(position), np.array(row)
    _, first, own, count = np.unique(owner_row, True, True, True)
    observations = Observations(position, np.tile(1e-4 * np.eye(3), (n, 1, 1)))
    log = RobotLog(
        name,
        False,
        np.linspace(0.0, 60.0, len(x)),
        np.zeros((len(x), 3)),
        np.array(frame),
        observations,
    )
    kept = count >= 3
    source = first[kept]
    viewing = viewing_of_log(log.iteration, position, first[own], path, source)
    there = owner_row[source]
    place = p_map[there] + rng.normal(0, noise_m, (len(there), 3)) * [1, 1, 0]
    look = wall.look[there] + rng.normal(0, 0.02, (len(there), 64))
    covariance = np.tile(noise_m**2 * np.eye(3), (len(there), 1, 1))
    landmarks = (place, covariance, count[kept].astype(np.int32), source.astype(np.int64))
    return LandmarkMap(*landmarks, look.astype(np.float32), None, False, name, None, viewing)


def between(first_a: float, first_b: float) -> Float:
    """Return T_a_b of maps whose robots started at these positions along the wall."""
    start_a, start_b = (np.array([x, 0.0, np.pi / 2]) for x in (first_a, first_b))
    return se2.between(start_a, start_b)
