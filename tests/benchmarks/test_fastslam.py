"""Time of one filter step, with a resampling forced in every step.

The robot drives laps on a ring road between walls full of landmarks, as dense as indoors.
The first lap fills the map, the next one is measured: each frame shows some of the landmarks in
view, others than the frame before, and landmarks come into view that were not touched for hundreds
of resamplings. Odometry is good, so that the laps meet and the map keeps its size.
"""

import os
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mapfusion.fastslam.association import Association
from mapfusion.fastslam.filter import FastSlam, FastSlamParameters
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.fastslam.proposal import Proposal
from mapfusion.geometry.se2 import compose, inverse, transform_points
from mapfusion.robot_log import Observations

SIGMA_M = 0.05
ROAD_M = 6.0  # landmarks stand up to half of this to the left and to the right
VIEW_M = 6.0
STEP_M = 0.1
LANDMARKS_PER_M = 40.0
MOTION = MotionNoise(
    0.002, 0.0002, 0.0005, 0, 0, lateral_m_per_sqrt_m=0.002, lateral_slip_m_per_rad=0
)
MEASURED_STEPS = 300
LONG_DRIVE_FRAMES = os.environ.get("LONG_DRIVE_FRAMES", "5000")
MIB = 2**20


class RingRoad:
    """Frames of a robot that drives round and round; a frame shows some landmarks ahead."""

    def __init__(self, n_landmarks: int, per_frame: int) -> None:
        rng = np.random.default_rng(0)
        self.rng, self.per_frame, self.n_landmarks = rng, per_frame, n_landmarks
        length_m = n_landmarks / LANDMARKS_PER_M
        self.radius_m = length_m / (2 * np.pi)
        self.angle = np.sort(rng.uniform(0, 2 * np.pi, n_landmarks))
        radius = self.radius_m + rng.uniform(-ROAD_M / 2, ROAD_M / 2, n_landmarks)
        self.point = np.stack(
            [
                radius * np.sin(self.angle),
                self.radius_m - radius * np.cos(self.angle),
                rng.uniform(0, 2, n_landmarks),
            ],
            -1,
        )
        descriptor = rng.standard_normal((n_landmarks, 64))
        self.descriptor = descriptor / np.linalg.norm(descriptor, axis=1, keepdims=True)
        self.step_rad = STEP_M / self.radius_m
        self.frames_a_lap = int(np.ceil(length_m / STEP_M))

    def frames(self) -> Iterator[tuple[np.ndarray, Observations]]:
        """Odometry and observations, without end."""
        chord = 2 * self.radius_m * np.sin(self.step_rad / 2)
        motion = np.array(
            [
                chord * np.cos(self.step_rad / 2),
                chord * np.sin(self.step_rad / 2),
                self.step_rad,
            ]
        )
        pose, ahead = np.zeros(3), 0.0
        covariance = np.tile(SIGMA_M**2 * np.eye(3), (self.per_frame, 1, 1))
        in_view = int(VIEW_M * LANDMARKS_PER_M)
        while True:
            first = np.searchsorted(self.angle, ahead % (2 * np.pi))
            offset = self.rng.choice(in_view, self.per_frame, replace=False)
            rows = (first + offset) % self.n_landmarks
            position = transform_points(inverse(pose), self.point[rows])
            position += self.rng.normal(0, SIGMA_M, position.shape)
            noisy = self.descriptor[rows] + self.rng.normal(0, 0.03, (self.per_frame, 64))
            noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
            noise = self.rng.standard_normal(3) * MOTION.standard_deviations(motion)
            yield (
                motion + noise if ahead else np.zeros(3),
                Observations(position, covariance, noisy.astype(np.float32), rows.astype(np.int32)),
            )
            pose, ahead = compose(pose, motion), ahead + self.step_rad


def mapped(
    association: str, n_landmarks: int, per_frame: int, proposal: str = "motion"
) -> tuple[FastSlam, Iterator[tuple[np.ndarray, Observations]]]:
    """A filter after its first lap, and the frames that follow."""
    road = RingRoad(n_landmarks, per_frame)
    settings = FastSlamParameters(
        motion=MOTION,
        proposal=Proposal(proposal),
        association=Association(association),
        resample_fraction=1.0,
    )
    slam, frames = FastSlam(settings, np.random.default_rng(1)), road.frames()
    for _ in range(road.frames_a_lap):
        slam.step(*next(frames))
    return slam, frames


@pytest.mark.parametrize(
    ("association", "n_landmarks", "per_frame", "proposal"),
    [
        ("label", 1_000, 20, "motion"),
        ("label", 10_000, 20, "motion"),
        ("descriptor", 1_500, 40, "motion"),
        ("descriptor", 10_000, 40, "motion"),
        ("gate", 1_500, 40, "motion"),
        ("label", 1_000, 20, "informed"),
        ("label", 10_000, 20, "informed"),
        ("descriptor", 1_500, 40, "informed"),
    ],
)
def test_step(benchmark, association, n_landmarks, per_frame, proposal):
    slam, frames = mapped(association, n_landmarks, per_frame, proposal)

    def next_frame():
        return next(frames), {}

    result = benchmark.pedantic(slam.step, setup=next_frame, rounds=MEASURED_STEPS)
    assert result.resampled
    assert 0.9 * n_landmarks <= result.n_landmarks <= 1.3 * n_landmarks
    percentile_ms = 1e3 * np.percentile(benchmark.stats.stats.data, 95)
    benchmark.extra_info["p95_ms"] = round(float(percentile_ms), 3)
    benchmark.extra_info["landmarks"] = result.n_landmarks
    sys.stdout.write(
        f"\n{association}, {n_landmarks} landmarks, {proposal}: p95 {percentile_ms:.2f} ms\n"
    )


def test_peak_memory_with_10_000_landmarks(benchmark):
    def peak_bytes() -> int:
        tracemalloc.start()
        try:
            slam, _ = mapped("label", 10_000, 20)
            assert len(slam.best_map(min_count=1)) >= 9_500
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak = benchmark.pedantic(peak_bytes, rounds=1)
    benchmark.extra_info["peak_mib"] = round(peak / MIB, 1)
    sys.stdout.write(f"\npeak memory with 10 000 landmarks: {peak / MIB:.0f} MiB\n")
    assert peak < 1024 * MIB


def test_a_long_drive(benchmark):
    """In a process of its own, for its memory; `make bench LONG_DRIVE_FRAMES=100000` for all."""
    command = [sys.executable, "-m", "tests.benchmarks.long_drive"]
    command += ["--frames", LONG_DRIVE_FRAMES, "--landmarks", LONG_DRIVE_FRAMES]
    root = Path(__file__).parents[2]

    def drive() -> str:
        return subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout

    sys.stdout.write("\n" + benchmark.pedantic(drive, rounds=1))
