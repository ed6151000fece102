"""Tests of `mapfusion.vision.tracking`."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from mapfusion.geometry.se2 import transform_points
from mapfusion.vision.front_end import FrontEnd
from mapfusion.vision.tracking import (
    PATCH_SIDE_PX,
    Features,
    Tracker,
    TrackParameters,
    link,
    projective_terms,
)
from tests.mapfusion.vision.rendered_scene import render, wall
from tests.mapfusion.vision.shifted_pictures import Picture

CAMERA = StereoCamera(320, 240, 288.0)
START, END = (4.5, 3.0), (4.0, -3.0)
BESIDE = (((8.0, -1.5), (0.5, -1.5)), ((0.5, 1.5), (8.0, 1.5)))  # on the right, and on the left


def on_wall(
    pose: np.ndarray,
    uv: np.ndarray,
    start: tuple[float, float] = START,
    end: tuple[float, float] = END,
) -> np.ndarray:
    """Intersect rays through pixels (N, 2) with the wall's plane."""
    eye = transform_points(pose, CAMERA.p_robot_left[None])[0]
    ray = transform_points(pose, CAMERA.back_project(uv, np.ones(len(uv)))) - eye
    normal = np.array([end[1] - start[1], start[0] - end[0], 0.0])
    depth = ((*start, 0.0) @ normal - eye @ normal) / (ray @ normal)
    return eye + depth[:, None] * ray


def test_the_point_stays_where_the_corner_strays() -> None:
    """Two metres towards a slanted wall, where each view's rays meet it."""
    rng = np.random.default_rng(0)
    room = [wall(rng, START, END, texels_per_m=120.0)]
    front_end, tracker = FrontEnd(CAMERA), Tracker(TrackParameters(), CAMERA, 0.1)
    points, corners = defaultdict(list), defaultdict(list)
    for t in range(11):
        pose = np.array([0.18 * t, 0.0, 0.008 * t])
        left, right, _ = render(room, CAMERA, tuple(pose), 1.0, rng)
        features = front_end.extract(left, right)
        tracks = tracker.update(features)
        point, corner = on_wall(pose, tracks.uv_px), on_wall(pose, features.uv_px)
        for i, track in enumerate(tracks.track_id):
            points[track].append(point[i])
            corners[track].append(corner[i])
    long = [track for track, seen in points.items() if len(seen) >= 10]
    assert len(long) > 8
    of_point, of_corner = (
        np.median([np.std(seen[track], axis=0).max() for track in long])
        for seen in (points, corners)
    )
    assert of_point < 0.4 * of_corner
    assert of_point < 0.002


@pytest.mark.parametrize("ends", BESIDE)
def test_points_of_walls_beside_the_way_do_not_slide(ends: tuple[tuple[float, float], ...]) -> None:
    """Fitted by an affine map they come 0.3 mm a frame towards the robot, all of them."""
    slides = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        room = [wall(rng, *ends, texels_per_m=60.0)]
        front_end, tracker = FrontEnd(CAMERA), Tracker(TrackParameters(), CAMERA, 0.1)
        points = defaultdict(list)
        for t in range(9):
            pose = np.array([0.12 * t, 0.0, 0.0])
            left, right, _ = render(room, CAMERA, tuple(pose), 1.0, rng)
            tracks = tracker.update(front_end.extract(left, right))
            for track, point in zip(
                tracks.track_id, on_wall(pose, tracks.uv_px, *ends), strict=True
            ):
                points[track].append(point)
        slides += [np.diff(np.array(seen)[:, 0]) for seen in points.values() if len(seen) > 2]
    slide = np.concatenate(slides)
    slide = slide[np.abs(slide) < 0.02]  # else it is another point
    error = slide.std() / np.sqrt(len(slide))
    assert error < 0.00005
    assert abs(slide.mean()) < 3 * error


@pytest.mark.parametrize("seed", range(5))
def test_a_window_bends_as_the_homography_of_its_plane(seed: int) -> None:
    """Points of a plane projected before and after driving; of the map at the point h is known."""
    rng, f = np.random.default_rng(seed), 400.0
    uv, d, slope = rng.uniform(-150, 150, 2), rng.uniform(5, 20), rng.uniform(-0.3, 0.3, 2)
    base, step = 0.12, np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.05, 0.05), 0.6])

    def later(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the later positions and disparities of the points at uv + x, (N, 2)."""
        disparity = d + x @ slope
        depth = f * base / disparity
        ray = np.column_stack([(uv + x) / f, np.ones(len(x))])
        point = depth[:, None] * ray - step
        return f * point[:, :2] / point[:, 2:], f * base / point[:, 2]

    place, now = later(np.zeros((1, 2)))
    small = 1e-4 * np.concatenate([np.eye(2), -np.eye(2)])
    moved = later(small)[0]
    A = ((moved[:2] - moved[2:]) / 2e-4).T
    (h,) = projective_terms(np.array([[d, *slope]]), now)
    x = rng.uniform(-8, 8, (20, 2))
    np.testing.assert_allclose(later(x)[0], place + x @ A.T / (1 + x @ h)[:, None], atol=1e-4)
    assert np.abs(x @ h).max() > 0.01


def test_the_disparity_is_that_of_the_point_and_not_of_the_corner() -> None:
    """The picture has moved by more than the corner that was found in it."""
    half, shift = PATCH_SIDE_PX // 2, np.array([1.5, -0.5])
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    tracker, picture = Tracker(TrackParameters(), CAMERA, 0.1), Picture(2)
    corner, slope = np.array([[100.0, 90.0]]), np.array([[0.1, -0.3]])
    for moved in (np.zeros(2), shift):
        patch = np.rint(np.clip(picture(u - moved[0], v - moved[1]), 0, 255)).astype(np.uint8)
        unit = np.eye(1, 64, dtype=np.float32)
        tracks = tracker.update(
            Features(corner, np.array([10.0]), np.array([0.1]), unit, slope, patch[None])
        )
    np.testing.assert_allclose(tracks.uv_px, corner + shift, atol=0.02)
    np.testing.assert_allclose(tracks.disparity_px, 10.0 + slope[0] @ shift, atol=0.01)


@pytest.mark.parametrize("patches", [True, False])
def test_what_looks_different_begins_a_new_track(patches: bool) -> None:
    """A link by descriptor between two places that look nothing alike; without patches it holds."""
    rng = np.random.default_rng(1)
    descriptor = np.eye(2, 64, dtype=np.float32)
    uv, disparity = np.array([[100.0, 100.0], [200.0, 100.0]]), np.full(2, 10.0)
    patch = rng.integers(0, 255, (2, PATCH_SIDE_PX, PATCH_SIDE_PX)).astype(np.uint8)
    tracker = Tracker(TrackParameters(), CAMERA, 0.1)
    shown = [patch, np.stack([patch[0], patch[0]])]
    for each in shown:
        features = Features(
            uv, disparity, np.full(2, 0.1), descriptor, patch=each if patches else None
        )
        tracks = tracker.update(features)
    assert tracks.length.tolist() == ([2, 1] if patches else [2, 2])
    np.testing.assert_allclose(tracks.uv_px, uv, atol=1e-6)


def unit(rng: np.random.Generator, n: int) -> np.ndarray:
    rows = rng.standard_normal((n, 64)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def features(
    uv: np.ndarray, descriptor: np.ndarray, disparity: np.ndarray | float = 10.0
) -> Features:
    n = len(uv)
    return Features(
        np.asarray(uv, float), np.full(n, disparity) * np.ones(n), np.full(n, 0.1), descriptor
    )


def empty() -> Features:
    return features(np.zeros((0, 2)), np.zeros((0, 64), np.float32))


def test_birth_confirmation_and_loss() -> None:
    rng = np.random.default_rng(0)
    descriptor = unit(rng, 3)
    uv = np.array([[100.0, 100], [200, 100], [300, 100]])
    tracker = Tracker(TrackParameters(min_length=3), StereoCamera(), 0.3)
    # feature 0 stays, 1 misses the third frame, 2 comes in the second
    seen = [[0, 1], [2, 1, 0], [0, 2], [1, 0, 2], []]
    ids, lengths, confirmed = [], [], []
    for t, rows in enumerate(seen):
        frame = features(uv[rows] + [5.0 * t, 0], descriptor[rows]) if rows else empty()
        tracks = tracker.update(frame)
        ids.append(tracks.track_id.tolist())
        lengths.append(tracks.length.tolist())
        confirmed.append(tracker.landmarks(tracks).tolist())
    assert ids == [[0, 1], [2, 1, 0], [0, 2], [3, 0, 2], []]
    assert lengths == [[1, 1], [1, 2, 2], [3, 2], [1, 4, 3], []]
    assert confirmed == [[False] * 2, [False] * 3, [True, False], [False, True, True], []]


def test_a_gap_ends_every_track() -> None:
    descriptor = unit(np.random.default_rng(0), 1)
    tracker = Tracker(TrackParameters(), StereoCamera(), 0.3)
    here = features(np.array([[50.0, 50.0]]), descriptor)
    assert tracker.update(here).track_id.tolist() == [0]
    tracker.update(empty())
    again = tracker.update(here)
    assert again.track_id.tolist() == [1]
    assert again.length.tolist() == [1]


def test_one_frame_suffices_when_asked() -> None:
    tracker = Tracker(TrackParameters(min_length=1), StereoCamera(), 0.3)
    tracks = tracker.update(features(np.zeros((2, 2)), unit(np.random.default_rng(0), 2)))
    assert tracker.landmarks(tracks).all()


def test_a_feature_that_slips_begins_a_new_track() -> None:
    """All but one move as a turning robot sees them; the one jumps by 6 pixels."""
    rng = np.random.default_rng(0)
    camera = StereoCamera()
    p_robot = rng.uniform((2, -0.8, 0), (4, 0.8, 1), (12, 3))
    descriptor = unit(rng, 12)
    tracker = Tracker(TrackParameters(), camera, 0.3)
    for t in range(3):
        uvd = camera.project(transform_points([-0.05 * t, 0, -0.05 * t], p_robot))
        uvd[7, 0] += 6.0 * (t == 2)
        tracks = tracker.update(features(uvd[:, :2], descriptor, uvd[:, 2]))
    assert tracks.length.tolist() == [3] * 7 + [1] + [3] * 4
    assert tracks.track_id.tolist() == [*range(7), 12, *range(8, 12)]
    own = camera.triangulate(tracks.uv_px, tracks.disparity_px, 0.3, 0.1)
    for found, expected in zip(tracker.points_m, own, strict=True):
        np.testing.assert_array_equal(found, expected)


def link_twin(previous: Features, current: Features, parameters: TrackParameters) -> list[int]:
    distance = np.linalg.norm(current.descriptor[:, None] - previous.descriptor[None], axis=-1)
    shift = np.abs(current.uv_px[:, None] - previous.uv_px[None])
    change = np.abs(np.log(current.disparity_px[:, None] / previous.disparity_px[None]))
    allowed = (shift <= [parameters.max_shift_u_px, parameters.max_shift_v_px]).all(-1)
    allowed &= change <= np.log(parameters.max_disparity_ratio)
    distance[~allowed] = np.inf
    rows = []
    for i in range(len(current)):
        j = int(np.argmin(distance[i]))
        mutual = np.argmin(distance[:, j]) == i
        near = distance[i, j] <= parameters.max_descriptor_distance
        rows.append(j if mutual and near else -1)
    return rows


@pytest.mark.parametrize("seed", range(4))
def test_links_equal_an_obvious_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    base = unit(rng, 60)
    uv = rng.uniform(0, 300, (60, 2))
    disparity = rng.uniform(5, 9, 60)
    previous = features(uv, base, disparity)
    noisy = base + 0.04 * rng.standard_normal(base.shape).astype(np.float32)
    order = rng.permutation(60)[:45]
    current = features(
        uv[order] + rng.normal(0, 20, (45, 2)),
        noisy[order],
        disparity[order] * rng.uniform(0.8, 1.25, 45),
    )
    parameters = TrackParameters(
        max_shift_u_px=40, max_shift_v_px=30, max_disparity_ratio=1.15, max_descriptor_distance=0.35
    )
    expected = link_twin(previous, current, parameters)
    assert 5 < np.sum(np.array(expected) >= 0) < 40
    assert link(previous, current, parameters).tolist() == expected


@pytest.mark.parametrize(
    ("shift", "disparity", "noise", "linked"),
    [
        ((0, 0), 10.0, 0.0, True),
        ((19, 0), 10.0, 0.0, True),
        ((-21, 0), 10.0, 0.0, False),
        ((0, 9), 10.0, 0.0, True),
        ((0, -11), 10.0, 0.0, False),
        ((0, 0), 11.9, 0.0, True),
        ((0, 0), 12.1, 0.0, False),
        ((0, 0), 10 / 1.19, 0.0, True),
        ((0, 0), 10 / 1.21, 0.0, False),
        ((0, 0), 10.0, 0.29, True),
        ((0, 0), 10.0, 0.31, False),
    ],
)
def test_each_limit_holds(
    shift: tuple[float, float], disparity: float, noise: float, linked: bool
) -> None:
    descriptor = np.zeros((1, 64), np.float32)
    descriptor[0, 0] = 1
    other = descriptor.copy()
    other[0, 1] = noise
    parameters = TrackParameters(3, 20, 10, 1.2, 0.3)
    uv = np.array([[100.0, 100.0]])
    source = link(features(uv, descriptor), features(uv + shift, other, disparity), parameters)
    assert source.tolist() == [0 if linked else -1]


@pytest.mark.parametrize(
    ("uv", "disparity", "steps"),
    [((200.0, 100.0), 10.0, 2.0), ((100.0, 140.0), 10.0, 2.0), ((100.0, 100.0), 16.0, 2.0)],
)
def test_a_pause_widens_the_limits(uv: tuple[float, float], disparity: float, steps: float) -> None:
    descriptor = unit(np.random.default_rng(0), 1)
    before = features(np.array([[100.0, 100.0]]), descriptor)
    after = features(np.array([uv]), descriptor, disparity)
    limits = TrackParameters(max_shift_u_px=60, max_shift_v_px=25, max_disparity_ratio=1.3)
    assert link(before, after, limits).tolist() == [-1]
    assert link(before, after, limits, steps).tolist() == [0]
    assert link(before, after, limits, 1e9).tolist() == [0]


def test_of_two_claims_the_nearer_wins() -> None:
    descriptor = np.zeros((2, 64), np.float32)
    descriptor[:, 0] = 1
    descriptor[1, 1] = 0.2
    uv = np.array([[100.0, 100.0], [103.0, 100.0]])
    one = features(uv[:1], descriptor[:1])
    assert link(one, features(uv, descriptor), TrackParameters()).tolist() == [0, -1]
    assert link(features(uv, descriptor), one, TrackParameters()).tolist() == [0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("min_length", 0),
        ("max_shift_u_px", 0.0),
        ("max_disparity_ratio", 1.0),
        ("max_descriptor_distance", -1.0),
    ],
)
def test_wrong_parameters_are_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{name}:"):
        replace(TrackParameters(), **{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("uv_px", np.zeros((2, 3))),
        ("disparity_px", np.ones(3)),
        ("disparity_px", np.array([1.0, 0.0])),
        ("sigma_disparity_px", np.array([1.0, np.nan])),
        ("descriptor", np.zeros((2, 32), np.float32)),
    ],
)
def test_wrong_features_are_named(name: str, value: np.ndarray) -> None:
    fields = {
        "uv_px": np.zeros((2, 2)),
        "disparity_px": np.ones(2),
        "sigma_disparity_px": np.ones(2),
        "descriptor": np.zeros((2, 64), np.float32),
    }
    with pytest.raises(ValueError, match=f"^{name}:"):
        Features(**(fields | {name: value}))
