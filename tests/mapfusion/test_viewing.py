"""From where landmarks were seen, and what was looked through: against places that are known."""

import numpy as np
import pytest

from mapfusion.viewing import BEARINGS, Viewing, _ends, part_of
from tests.mapfusion.evidence.two_rooms import FARTHEST_M, HALF_VIEW_RAD, Wall, mapped


def evidence(last_x: float = 6.0) -> tuple[Viewing, np.ndarray]:
    landmarks = mapped(Wall(8, seed=1), 2, last_x, seed=2, noise_m=1e-6)
    assert landmarks.viewing is not None
    return landmarks.viewing, landmarks.position_m


def test_directions_and_distances_are_means_over_the_frames_that_saw_them() -> None:
    viewing, position = evidence()
    for k in range(0, len(viewing), 7):
        apart = position[k, :2] - viewing.pose[:, :2]
        bearing = np.arctan2(apart[:, 1], apart[:, 0]) - viewing.pose[:, 2]
        range_m = np.hypot(*apart.T)
        seen = (np.abs(bearing) < HALF_VIEW_RAD) & (range_m < FARTHEST_M)
        assert viewing.n_views[k] == seen.sum()
        assert viewing.distance_m[k] == pytest.approx(range_m[seen].mean(), abs=1e-4)
        assert viewing.direction_rad[k] == pytest.approx(
            (bearing + viewing.pose[:, 2])[seen].mean(), abs=0.01
        )


def test_it_reaches_as_far_as_landmarks_were_seen() -> None:
    """A wall 3 m ahead: 3 m / cos(bearing), as nearly as landmarks lie in each part."""
    viewing, _ = evidence()
    low, high = viewing.field.bearing_rad
    assert -HALF_VIEW_RAD <= low < -0.9 * HALF_VIEW_RAD
    assert 0.9 * HALF_VIEW_RAD < high <= HALF_VIEW_RAD
    middle = low + (np.arange(BEARINGS) + 0.5) * (high - low) / BEARINGS
    seen = viewing.reach_m > 0
    expected = np.broadcast_to(3 / np.cos(middle), viewing.reach_m.shape)
    np.testing.assert_allclose(viewing.reach_m[seen], expected[seen], atol=0.15)
    assert seen.mean() > 0.4
    assert viewing.field.range_m == pytest.approx([3.0, 3.0 / np.cos(HALF_VIEW_RAD)], abs=0.05)


def test_ends_are_numpy_s_quantiles_bit_for_bit() -> None:
    rng = np.random.default_rng(0)
    for n in (20, 999, 1000, 1001, 4321, 50_000):
        for values in (rng.normal(size=n), np.sort(rng.random(n)), rng.integers(0, 9, n) / 7):
            expected = np.quantile(values, [0.005, 0.995])
            np.testing.assert_array_equal(_ends(values), expected)


def test_ends_that_the_sample_does_not_show_are_looked_for_among_all() -> None:
    values = np.where(np.arange(4800) % 16 == 0, np.arange(4800) / 1e4, 1.0)
    values[::16] *= np.where(np.arange(300) < 150, -1, 1)
    for few in (values, values - 1, -values):
        np.testing.assert_array_equal(_ends(few), np.quantile(few, [0.005, 0.995]))


def test_bearings_beyond_the_field_of_view_are_in_its_last_parts() -> None:
    field = evidence()[0].field
    low, high = field.bearing_rad
    edges = part_of(np.array([low - 1, low, high, high + 1]), field)
    assert edges.tolist() == [0, 0, BEARINGS - 1, BEARINGS - 1]


def test_some_landmarks_of_a_map_keep_theirs_and_all_frames() -> None:
    landmarks = mapped(Wall(8, seed=1), 2, 4, seed=2)
    rows = np.array([5, 2])
    some, viewing = landmarks[rows].viewing, landmarks.viewing
    assert some is not None
    assert viewing is not None
    np.testing.assert_array_equal(some.distance_m, viewing.distance_m[rows])
    assert len(some.pose) == len(viewing.pose)
    with pytest.raises(ValueError, match="viewing: of 2 landmarks"):
        landmarks.__class__(**{**vars(landmarks), "viewing": some})


def test_joined_landmarks_are_turned() -> None:
    viewing, _ = evidence()
    both = viewing.joined(viewing[:3], np.pi / 2)
    assert len(both) == len(viewing) + 3
    turned = viewing.direction_rad[:3] + np.pi / 2
    np.testing.assert_allclose(np.cos(both.direction_rad[-3:]), np.cos(turned), atol=1e-12)
    np.testing.assert_array_equal(both.pose, viewing.pose)
