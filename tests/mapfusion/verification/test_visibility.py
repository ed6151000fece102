"""Tests of `mapfusion.verification.visibility`, with a slow reference and a known wall."""

import inspect
import math

import numpy as np
import pytest

from mapfusion.align.nearest_neighbours import Grid
from mapfusion.fastslam.mapping import run_log
from mapfusion.verification.regions import ViewedMap
from mapfusion.verification.visibility import (
    LEAST_FRAMES,
    MAY,
    MUST,
    SURE_FRAMES,
    UNSEEN,
    ObservedLandmarks,
    ViewingHistory,
    classify_visibility,
    wall_directions,
)
from mapfusion.viewing import BEARINGS, RANGES, FieldOfView, Viewing
from mapfusion.vision.tracking import TrackParameters
from tests.mapfusion.verification.two_rooms import Wall, between, mapped


def slowly(seen: ObservedLandmarks, viewing: Viewing) -> list[int]:
    """Classify the visibility of each landmark from all poses, by angles."""
    how, field = [], viewing.field
    low, high = field.bearing_rad
    x, y, theta = viewing.pose.T
    for p, direction, before, wall in zip(*seen, strict=True):
        own_sine = abs(direction[0] * wall[1] - direction[1] * wall[0])
        sight = np.stack([p[0] - x, p[1] - y])
        range_m = np.hypot(*sight)
        away = np.maximum(range_m, 1e-12)
        slant = np.arccos(np.clip(direction @ sight / away, -1, 1))
        sine = np.abs(sight[0] * wall[1] - sight[1] * wall[0]) / away
        bearing = np.angle(np.exp(1j * (np.arctan2(sight[1], sight[0]) - theta)))

        step = np.minimum((8 * range_m / field.range_m[1]).astype(int), 7)
        lowest, highest = field.height_m[step].T
        part = np.clip((16 * (bearing - low) / (high - low)).astype(int), 0, 15)
        farthest = viewing.reach_m[np.arange(len(x)), part] + 0.3
        in_view = (low <= bearing) & (bearing <= high) & (range_m > 0) & (range_m <= farthest)
        in_view &= (field.range_m[0] <= range_m) & (range_m <= field.range_m[1])
        in_view &= (lowest <= p[2]) & (p[2] <= highest)
        views = []
        for ratio, most_deg in ((2.0, 45), (1.4, 30)):
            near = (before / ratio <= range_m) & (range_m <= ratio * before)
            facing = (own_sine / ratio <= sine) & (sine <= ratio * own_sine)
            views.append(np.sum(in_view & near & facing & (slant <= math.radians(most_deg))))
        seen_so = MAY if views[0] >= LEAST_FRAMES else UNSEEN
        how.append(MUST if views[1] >= SURE_FRAMES else seen_so)
    return how


def walls(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return unit vectors (n, 2), a third of them 0."""
    angle = rng.uniform(-np.pi, np.pi, n)
    known = rng.uniform(size=n) > 1 / 3
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) * known[:, None]


def test_equals_the_slow_twin_on_any_places() -> None:
    rng = np.random.default_rng(0)
    landmarks = mapped(Wall(8, seed=1), 1, 6, seed=2)
    assert landmarks.viewing is not None
    n, angle = 8000, rng.uniform(-0.8, 0.8, 8000)
    places = np.stack([rng.uniform(1, 4, n), rng.uniform(-6, 2, n), rng.uniform(0, 1.3, n)], axis=1)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    seen = ObservedLandmarks(places, direction, rng.uniform(1.5, 7, n), walls(rng, n))
    how = classify_visibility(seen, ViewingHistory.of(landmarks.viewing))
    assert how.tolist() == slowly(seen, landmarks.viewing)
    assert np.bincount(how, minlength=3).min() > 50


@pytest.mark.parametrize("half_view_rad", [0.4, 2.0])
def test_equals_the_slow_twin_on_a_path_that_winds(half_view_rad: float) -> None:
    """The robot turns within blocks of frames, and the last block is shorter."""
    rng = np.random.default_rng(1)
    n_frames, n = 100 * LEAST_FRAMES + 3, 3000
    theta = np.cumsum(rng.normal(0, 0.2, n_frames))
    steps = 0.1 * np.stack([np.cos(theta), np.sin(theta)], axis=1)
    path = np.column_stack([np.cumsum(steps, axis=0), theta])
    heights = np.tile([0.1, 1.2], (RANGES, 1))
    field = FieldOfView(np.array([-1.0, 0.9]) * half_view_rad, np.array([0.5, 6.0]), heights)
    reach = rng.uniform(0, 6, (n_frames, BEARINGS)).astype(np.float32)
    nothing = np.zeros(0)
    viewing = Viewing(nothing, nothing, nothing.astype(np.int32), path, reach, field)
    angle, at = rng.uniform(-np.pi, np.pi, n), path[rng.integers(0, n_frames, n), :2]
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    distance = rng.uniform(0.5, 6, n)
    places = np.column_stack([at + distance[:, None] * direction, rng.uniform(0, 1.4, n)])
    seen = ObservedLandmarks(places, direction, distance, walls(rng, n))
    how = classify_visibility(seen, ViewingHistory.of(viewing))
    assert how.tolist() == slowly(seen, viewing)
    assert np.bincount(how, minlength=3).min() > 20


@pytest.mark.parametrize("half_view_rad", [0.4, 2.0])
def test_what_is_straight_behind_is_not_in_view(half_view_rad: float) -> None:
    """The robot turns once, so that a block contains different headings."""
    n_frames, one = SURE_FRAMES + 1, np.ones(1)
    path = np.zeros((n_frames, 3))
    path[0, 2] = 3.1
    field = FieldOfView(
        np.array([-1.0, 0.9]) * half_view_rad,
        np.array([0.5, 6.0]),
        np.tile([0.0, 1.0], (RANGES, 1)),
    )
    reach = np.full((n_frames, BEARINGS), 5.0, np.float32)
    ways = one, one, np.ones(1, np.int32), path, reach, field
    for x, how in ((2.0, MUST), (-2.0, UNSEEN)):
        place, direction = np.array([[x, 0.0, 0.5]]), np.array([[np.sign(x), 0.0]])
        seen = ObservedLandmarks(place, direction, 2 * one, np.zeros((1, 2)))
        assert classify_visibility(seen, ViewingHistory.of(Viewing(*ways))).tolist() == [how]


def test_where_nothing_was_seen_nothing_is_in_view() -> None:
    nowhere = FieldOfView(np.zeros(2), np.zeros(2), np.tile([1.0, 0.0], (RANGES, 1)))
    one, path = np.ones(1), np.zeros((9, 3))
    reach = np.zeros((9, BEARINGS), np.float32)
    viewing = Viewing(one, one, np.ones(1, np.int32), path, reach, nowhere)
    place, direction = np.array([[0.2, 0.0, 0.5]]), np.array([[1.0, 0.0]])
    seen = ObservedLandmarks(place, direction, 0.2 * one, np.zeros((1, 2)))
    assert classify_visibility(seen, ViewingHistory.of(viewing)).tolist() == [UNSEEN]


def test_what_must_be_seen_was_in_view_for_as_long_as_a_landmark_takes() -> None:
    first_observation = TrackParameters().min_length
    min_count = inspect.signature(run_log).parameters["min_count"].default
    assert first_observation + min_count - 1 == LEAST_FRAMES


def test_of_the_same_wall_what_lies_before_both_robots_must_be_seen() -> None:
    wall = Wall(12, seed=5)
    a, b = (ViewedMap(mapped(wall, *ends, seed=6)) for ends in ((1, 6), (4, 10)))
    own = b.observed_from(between(1, 4))
    rows = np.flatnonzero(classify_visibility(own, a.history) == MUST)
    along_wall_m = 1 - own.p[:, 1]  # frame a looks at the wall: its y is the world's -x
    inside = (along_wall_m > 4.5) & (along_wall_m < 5.5)
    assert np.isin(np.flatnonzero(inside), rows).mean() > 0.95
    assert not np.isin(np.flatnonzero(along_wall_m > 8), rows).any()


def test_behind_a_wall_nothing_must_be_seen() -> None:
    a = ViewedMap(mapped(Wall(8, seed=7), 1, 6, seed=8))
    here = a.observed_from(np.zeros(3))
    behind = here._replace(p=here.p + np.array([1.5, 0.0, 0.0]))
    along_wall_m = 1 - here.p[:, 1]
    passed = (along_wall_m > 1) & (along_wall_m < 6)  # what lies at the ends was in view for less
    assert np.mean(classify_visibility(here, a.history)[passed] == MUST) > 0.95
    assert not classify_visibility(behind, a.history).any()


def test_from_the_other_side_nothing_must_be_seen() -> None:
    a = ViewedMap(mapped(Wall(8, seed=7), 1, 6, seed=8))
    here = a.observed_from(np.zeros(3))
    assert not classify_visibility(here._replace(direction=-here.direction), a.history).any()


def test_a_wall_seen_along_its_face_is_not_seen_alike_from_the_front() -> None:
    """Both lines of sight differ by 25 degrees, within the tolerance of directions."""
    n_frames, one = SURE_FRAMES, np.ones(1)
    field = FieldOfView(
        np.array([-0.5, 0.5]), np.array([0.5, 6.0]), np.tile([0.0, 1.0], (RANGES, 1))
    )
    viewing = Viewing(
        one,
        one,
        np.ones(1, np.int32),
        np.zeros((n_frames, 3)),
        np.full((n_frames, BEARINGS), 5.0, np.float32),
        field,
    )
    before = math.radians(25)
    direction = np.array([[math.cos(before), math.sin(before)]])
    for wall_degrees, how in ((90, MUST), (0, UNSEEN), (-35, MAY)):
        angle = math.radians(wall_degrees)
        wall = np.array([[math.cos(angle), math.sin(angle)]])
        seen = ObservedLandmarks(np.array([[3.0, 0.0, 0.5]]), direction, 3 * one, wall)
        assert classify_visibility(seen, ViewingHistory.of(viewing)).tolist() == [how]


def test_walls_have_directions_and_their_corners_have_none() -> None:
    rng = np.random.default_rng(2)
    turn = math.radians(25)
    along = np.array([math.cos(turn), math.sin(turn)])
    across = np.array([-along[1], along[0]])
    steps = np.arange(0, 6, 0.1)
    wall, side = steps[:, None] * along, steps[:, None] * across
    p = np.concatenate([wall, side, [[-5.0, -5.0]]])
    p += rng.normal(0, 0.01, p.shape)
    found = wall_directions(Grid.of(p))
    n, far = len(steps), steps > 0.6
    off_along, off_across = np.abs(found @ across), np.abs(found @ along)
    assert off_along[:n][far].max() < 0.1
    assert off_across[n : 2 * n][far].max() < 0.1
    np.testing.assert_allclose(np.linalg.norm(found[: 2 * n][np.tile(far, 2)], axis=1), 1)
    assert not found[[0, n, 2 * n]].any()  # the corner, twice, and a landmark alone
