"""A drive through a house without end: whether a step costs the last frames what it cost the first.

    python -m tests.benchmarks.long_drive --frames 100000 --landmarks 100000 --particles 200

Rooms stand in rows. The robot drives through a row to its end, turns, comes back through it and
goes on to the next. So half of what it sees is new, and half was last seen up to 2500 frames ago.
Times are of the processor, as a long drive is seldom alone on its machine.
"""

import argparse
import resource
import sys
import time

import numpy as np

from mapfusion.fastslam.association import Association
from mapfusion.fastslam.filter import FastSlam, FastSlamParameters
from mapfusion.fastslam.mapping import run_log
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.se2 import compose, inverse, transform_points
from mapfusion.robot_log import Observations, RobotLog

ROOM_M, ROOMS_A_ROW = 8.0, 16
STEP_M, TURN_STEPS = 0.1, 10  # a quarter turn takes so many frames
VIEW_M = (0.5, 6.0)  # ahead, and no farther to the side than ahead
SEEN_A_FRAME = 20
SIGMA_M, LOOKS_SIGMA = 0.05, 0.03
FRAME_S = 0.2
MOTION = MotionNoise(
    0.002, 0.0002, 0.0005, 0, 0, lateral_m_per_sqrt_m=0.002, lateral_slip_m_per_rad=0
)
ROW_STEPS = round(ROOM_M * ROOMS_A_ROW / STEP_M)
AISLE_STEPS = round(ROOM_M / STEP_M)
FRAMES_A_ROW = 2 * ROW_STEPS + AISLE_STEPS + 4 * TURN_STEPS


def true_motions(n_frames: int) -> np.ndarray:
    """(T, 3): along a row, about, back, and over to the next."""
    ahead, quarter = np.array([STEP_M, 0, 0]), np.array([0, 0, np.pi / 2 / TURN_STEPS])
    legs = [(ahead, ROW_STEPS), (quarter, 2 * TURN_STEPS), (ahead, ROW_STEPS)]
    legs += [(-quarter, TURN_STEPS), (ahead, AISLE_STEPS), (-quarter, TURN_STEPS)]
    row = np.concatenate([np.tile(motion, (n, 1)) for motion, n in legs])
    return np.tile(row, (n_frames // len(row) + 1, 1))[:n_frames]


class House:
    """Landmarks (L, 3), sorted by row and along it, with descriptors (L, 64)."""

    def __init__(self, n_landmarks: int, n_frames: int, rng: np.random.Generator) -> None:
        n_rows = -(-n_frames // FRAMES_A_ROW)
        last_m = STEP_M * min(n_frames, ROW_STEPS)  # what a short drive sees of its row
        along = rng.uniform(0, min(ROOM_M * ROOMS_A_ROW, last_m + VIEW_M[1]), n_landmarks)
        row = rng.integers(n_rows, size=n_landmarks)
        across = (row + rng.uniform(-0.5, 0.5, n_landmarks)) * ROOM_M
        order = np.lexsort((along, row))
        self.point = np.stack([along, across, rng.uniform(0, 2, n_landmarks)], -1)[order]
        self.first = np.searchsorted(row[order], np.arange(n_rows + 1))
        looks = rng.standard_normal((n_landmarks, 64), dtype=np.float32)
        self.descriptor = looks / np.linalg.norm(looks, axis=1, keepdims=True)

    def in_view(self, pose: np.ndarray) -> np.ndarray:
        """Landmarks of the pose's row that are in view."""
        row = int(np.clip(np.rint(pose[1] / ROOM_M), 0, len(self.first) - 2))
        first, stop = self.first[row], self.first[row + 1]
        reach = pose[0] + np.array([-1, 1]) * np.sqrt(2) * VIEW_M[1]
        near = first + np.searchsorted(self.point[first:stop, 0], reach)
        ahead, aside, _ = transform_points(inverse(pose), self.point[slice(*near)]).T
        seen = (ahead > VIEW_M[0]) & (ahead < VIEW_M[1]) & (np.abs(aside) < ahead)
        return near[0] + np.flatnonzero(seen)


def log_of(house: House, n_frames: int, looks: bool, rng: np.random.Generator) -> RobotLog:
    """Return the robot's observations, without descriptors unless they are asked for."""
    motion = true_motions(n_frames)
    motion[0] = 0
    pose, rows, position = np.array([0, 0, 0.0]), [], []
    for step in motion:
        pose = compose(pose, step)
        view = house.in_view(pose)
        row = rng.choice(view, min(SEEN_A_FRAME, len(view)), replace=False)
        rows.append(row)
        position.append(transform_points(inverse(pose), house.point[row]))
    label = np.concatenate(rows).astype(np.int32)
    n, descriptor = len(label), None
    if looks:
        descriptor = house.descriptor[label]
        for some in np.array_split(descriptor, -(-n // 1000)):
            some += LOOKS_SIGMA * rng.standard_normal(some.shape, dtype=np.float32)
    sigma = np.array([MOTION.standard_deviations(step) for step in motion])
    observations = Observations(
        np.concatenate(position) + rng.normal(0, SIGMA_M, (n, 3)),
        np.tile(SIGMA_M**2 * np.eye(3), (n, 1, 1)),
        descriptor,
        label,
    )
    iteration = np.repeat(np.arange(n_frames, dtype=np.int32), [len(row) for row in rows])
    odometry = motion + sigma * rng.standard_normal((n_frames, 3))
    time_s = FRAME_S * np.arange(n_frames)
    return RobotLog("R1", False, time_s, odometry, iteration, observations)


def peak_mib() -> float:
    """The most memory that this process ever had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--landmarks", type=int, default=100_000)
    parser.add_argument("--particles", type=int, default=200)
    parser.add_argument("--association", type=Association, default=Association.LABEL)
    asked = parser.parse_args()
    rng = np.random.default_rng(0)
    house = House(asked.landmarks, asked.frames, rng)
    log = log_of(house, asked.frames, asked.association is Association.DESCRIPTOR, rng)
    del house
    settings = FastSlamParameters(
        n_particles=asked.particles, motion=MOTION, association=asked.association
    )
    say(f"{len(log)} frames, {len(log.observations)} observations, log: {peak_mib():.0f} MiB")
    tenth = -(-asked.frames // 10)
    times_s: list[float] = []
    medians, resampled, before = [], 0, time.process_time()
    for frame in run_log(log, settings, np.random.default_rng(1)):
        now = time.process_time()
        times_s.append(now - before)
        resampled += frame.result.resampled
        if len(times_s) % tenth == 0 or len(times_s) == asked.frames:
            medians.append(summary(frame.iteration + 1, times_s[-tenth:], frame.slam, resampled))
            resampled = 0
        before = time.process_time()
    say(f"last tenth over second tenth: {medians[-1] / medians[1]:.2f}; peak {peak_mib():.0f} MiB")


def summary(n_frames: int, times_s: list[float], slam: FastSlam, resampled: int) -> float:
    """One line on a tenth of the drive; the median of its steps in ms."""
    median, p95 = 1e3 * np.percentile(times_s, (50, 95))
    say(
        f"{n_frames:7d} frames: median {median:.2f} ms, p95 {p95:.2f}, {slam.n_slots} landmarks, "
        f"{resampled} resamplings, peak {peak_mib():.0f} MiB"
    )
    return float(median)


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
