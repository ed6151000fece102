"""The smoother on drives of known truth whose odometry is better or worse than stated.

`python -m tests.benchmarks.synthetic_drives` tries many more.
"""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from mapfusion.smoother.elimination import memory_bytes
from mapfusion.smoother.problem import OrderedObservations, order_observations
from mapfusion.smoother.smooth import condensed_points
from tests.benchmarks.synthetic_drives import LANDMARK_LIMITS, MOST_PATH, nees, smoothed
from tests.helpers.synthetic_drives import Drive, drive
from tests.mapfusion.smoother.white_noise_logs import white_noise_log


@pytest.mark.parametrize(
    ("shape", "n_frames", "noise", "n_seeds"),
    [
        ("lap", 600, 0.0, 1),
        ("lap", 600, 0.3, 1),
        ("laps", 150, 0.1, 3),
        ("back", 100, 5.0, 4),
        ("straight", 150, 5.0, 4),
        ("stops", 100, 1.0, 4),
        ("still", 60, 1.0, 4),
    ],
)
def test_errors_obey_the_covariances(shape: str, n_frames: int, noise: float, n_seeds: int) -> None:
    """Whatever the odometry is beside what it states; exact odometry may err less."""
    found = []
    for seed in range(n_seeds):
        driven = drive(shape, n_frames, noise, seed)
        found.append(nees(driven, smoothed(driven)))
    landmark, path = np.mean(found, axis=0)
    least, most = LANDMARK_LIMITS
    assert (least if noise else 0) < landmark < most
    assert path < MOST_PATH


def test_odometry_much_worse_than_stated_does_not_make_observations_gross() -> None:
    """Under the stated level they contradict it, and the first path stays far off."""
    driven = drive("back", 100, 5.0, seed=0)
    found = smoothed(driven)
    assert nees(driven, found).landmark < 2
    assert found.odometry_scales.min() > 5


def test_much_noisier_odometry_has_the_variances_of_its_motion() -> None:
    """The noise that is stated for noisy increments is another one.

    The robot drives straight in most frames. Noisy increments seem to turn, and the variance stated
    for turns is larger.
    """
    scales = [smoothed(drive("lap", 600, 5.0, seed)).odometry_scales for seed in range(3)]
    along, across, heading = np.mean(scales, axis=0)
    assert along == pytest.approx(25, rel=0.15)
    assert across == pytest.approx(25, rel=0.25)
    assert 10 < heading < 30


def many_sightings(seed: int) -> Drive:
    """Few frames with many landmarks in view: the matrices are small beside the observations."""
    return Drive(*white_noise_log(np.random.default_rng(seed), 40, 600))


@pytest.mark.parametrize(
    ("driven", "landmarks_first"),
    [
        (lambda: drive("laps", 300, 1.0, 0, tracks=True), True),
        (lambda: drive("lap", 400, 1.0, 0), True),
        (lambda: drive("laps", 400, 1.0, 0), False),
        (lambda: drive("still", 300, 1.0, 0), False),
        (lambda: many_sightings(0), True),
    ],
)
def test_memory_is_bounded_closely(driven: Callable[[], Drive], landmarks_first: bool) -> None:
    """By no more than three times what arrays take at once while a log becomes a map.

    Either the landmarks or the poses are eliminated first, whichever takes fewer products.
    """
    made = driven()
    obs = smoothed(made).obs  # also compiles the kernels
    n_points = obs.n_landmarks + int(obs.has_offset.sum())
    assert obs.order.is_sparser_than(n_points) == landmarks_first
    tracemalloc.start()
    try:
        found = smoothed(made)
        condensed_points(found)
        _, used = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert used < memory_bytes(found.obs) < 3 * used


def test_memory_grows_with_the_log_and_not_with_its_square() -> None:
    """A KITTI-length log of one lap takes less than the default of 1 GB."""
    n_frames = np.array([1000, 4541])
    needed = [memory_bytes(_seen(drive("lap", int(n), 1.0, 0))) for n in n_frames]
    assert needed[1] / needed[0] < 1.5 * n_frames[1] / n_frames[0]
    assert needed[1] < 1e9


def _seen(driven: Drive) -> OrderedObservations:
    label = driven.log.observations.label
    assert label is not None
    return order_observations(driven.log, label, 3, with_offsets=True)


def test_what_may_take_more_than_is_given_is_refused() -> None:
    driven = drive("lap", 100, 1.0, 0)
    needed_gb = memory_bytes(_seen(driven)) / 1e9
    with pytest.raises(MemoryError, match=r"may take .* GB"):
        smoothed(driven, max_memory_gb=0.99 * needed_gb)
    smoothed(driven, max_memory_gb=1.01 * needed_gb)
