"""The front end as a whole, on rendered planes whose depth is known."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from mapfusion.geometry.se2 import transform_points
from mapfusion.robot_log import Observations
from mapfusion.vision.front_end import FrontEnd, FrontEndParameters, observable
from mapfusion.vision.surf import USurfParameters
from mapfusion.vision.tracking import Features, Tracker, TrackParameters
from tests.mapfusion.vision.rendered_scene import Plane, render, wall

CAMERA = StereoCamera()


# from a corner of the room, on a side wall that is seen at a slant: half a window is 8 px, a
# hundredth of a metre each at 5 m, three and more times that along the slant
FOLD_M = 0.3


@pytest.fixture(scope="module")
def room() -> list[Plane]:
    """A corridor of 3.4 m with an end wall at x = 5 m; the planes fill the image."""
    rng = np.random.default_rng(4)
    return [
        wall(rng, (5, 1.8), (5, -1.8), 8.0, -3.0),
        wall(rng, (-1, 1.7), (5, 1.7), 8.0, -3.0, texels_per_m=40),
        wall(rng, (-1, -1.7), (5, -1.7), 8.0, -3.0, texels_per_m=40),
    ]


def everything(features: Features) -> np.ndarray:
    return np.ones(len(features), bool)


def observe(
    camera: StereoCamera, features: Features, keep: np.ndarray, parameters: FrontEndParameters
) -> Observations:
    """Return the observations of features without tracks."""
    given = (features.disparity_px, features.sigma_disparity_px)
    rows = observable(camera, *given, keep, parameters)
    uv, disparity, sigma = (values[rows] for values in (features.uv_px, *given))
    points = camera.triangulate(uv, disparity, parameters.sigma_uv_px, sigma)
    uvd = np.column_stack([uv, disparity])
    return Observations(*points, features.descriptor[rows], uvd_px=uvd)


def test_points_lie_on_the_walls_within_their_covariance(room: list[Plane]) -> None:
    rng = np.random.default_rng(0)
    parameters = FrontEndParameters()
    left, right, _ = render(room, CAMERA, (0.2, 0.1, 0.1), 2.0, rng)
    features = FrontEnd(CAMERA, parameters).extract(left, right)
    seen = observe(CAMERA, features, everything(features), parameters)
    assert len(seen) > 70
    p_world = transform_points([0.2, 0.1, 0.1], seen.position_m)
    # distance to the nearest wall, along its normal, against the variance in that direction
    distance = np.stack([p_world[:, 0] - 5, p_world[:, 1] - 1.7, p_world[:, 1] + 1.7], -1)
    nearest = np.abs(distance).argmin(1)
    normal_world = np.array([[1, 0, 0], [0, 1, 0], [0, 1, 0]], float)[nearest]
    normal = transform_points([0, 0, -0.1], normal_world)
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", normal, seen.covariance_m2, normal))
    deviation = distance[np.arange(len(seen)), nearest] / sigma
    # a window that reaches around a corner of the room shows no plane
    off_m = np.sort(np.abs(distance), axis=1)
    folded = off_m[:, 1] < FOLD_M
    assert np.mean(np.abs(deviation[~folded]) < 3) > 0.98
    assert 0.6 < np.sqrt(np.mean(deviation[~folded] ** 2)) < 1.2
    assert off_m[folded, 0].max() < 0.1


def test_features_fill_the_frame_in_a_fixed_order(room: list[Plane]) -> None:
    left, right, _ = render(room, CAMERA, noise=2.0, rng=np.random.default_rng(1))
    front_end = FrontEnd(CAMERA)
    first, second = front_end.extract(left, right), front_end.extract(left, right)
    for name in ("uv_px", "disparity_px", "sigma_disparity_px", "descriptor"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert first.descriptor.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(first.descriptor, axis=1), 1, atol=1e-6)
    quadrant = (first.uv_px > [320, 240]) @ [1, 2]
    assert np.bincount(quadrant, minlength=4).min() > 10


def test_landmarks_come_from_tracks_of_a_moving_robot(room: list[Plane]) -> None:
    rng = np.random.default_rng(2)
    front_end, parameters = FrontEnd(CAMERA), FrontEndParameters()
    tracker = Tracker(parameters.tracks, CAMERA, parameters.sigma_uv_px)
    places: dict[int, list[np.ndarray]] = {}
    for t in range(5):
        pose = (0.08 * t, 0.0, 0.05 * t)
        left, right, _ = render(room, CAMERA, pose, 2.0, rng)
        features = front_end.extract(left, right)
        tracks = tracker.update(features)
        own = (tracks.uv_px, tracks.disparity_px, 0.08, features.sigma_disparity_px)
        for found, expected in zip(tracker.points_m, CAMERA.triangulate(*own), strict=True):
            np.testing.assert_array_equal(found, expected)
        keep = tracker.landmarks(tracks)
        seen = observe(CAMERA, features, keep, parameters)
        assert len(seen) == 0 if t < 2 else len(seen) > 35
        depth = CAMERA.focal_px * CAMERA.baseline_m / features.disparity_px
        rows = np.nonzero(keep)[0]
        p_robot = CAMERA.back_project(features.uv_px[rows], depth[rows])
        p_world = transform_points(pose, p_robot)
        for track, point in zip(tracks.track_id[rows], p_world, strict=True):
            places.setdefault(int(track), []).append(point)
    spread = [np.ptp(np.array(p), axis=0).max() for p in places.values() if len(p) > 1]
    assert len(spread) > 40
    assert np.mean(np.array(spread) < 0.3) > 0.9


def correct_matches(a: Features, b: Features, pose_a: tuple, pose_b: tuple) -> int:
    """Mutual nearest descriptors whose points lie within 0.1 m of each other in the world."""
    p_a, p_b = (
        transform_points(
            pose, CAMERA.back_project(f.uv_px, CAMERA.focal_px * 0.09 / f.disparity_px)
        )
        for f, pose in ((a, pose_a), (b, pose_b))
    )
    likeness = a.descriptor @ b.descriptor.T
    to_b, to_a = likeness.argmax(1), likeness.argmax(0)
    mutual = np.nonzero(to_a[to_b] == np.arange(len(a)))[0]
    return int(np.sum(np.linalg.norm(p_a[mutual] - p_b[to_b[mutual]], axis=1) < 0.1))


def test_a_metric_window_matches_better_across_distances(room: list[Plane]) -> None:
    rng = np.random.default_rng(3)
    far, near = (0.0, 0.0, 0.0), (2.2, 0.0, 0.0)
    views = [render(room, CAMERA, pose, 2.0, rng)[:2] for pose in (far, near)]
    metric = USurfParameters(window="metric")
    # the fixed window is the metric one of the far view, so that only the near one differs
    scale_px = metric.scales_px(np.array([5 - CAMERA.mount_x_m]), CAMERA.focal_px)[0]
    found = {}
    for window in (metric, USurfParameters(window="pixels", scale_px=scale_px)):
        parameters = FrontEndParameters(usurf=window)
        features = [FrontEnd(CAMERA, parameters).extract(*view) for view in views]
        found[window.window] = correct_matches(*features, far, near)
    assert found["metric"] >= 2 * found["pixels"]


def test_far_and_uncertain_points_are_not_observed() -> None:
    disparity = CAMERA.focal_px * CAMERA.baseline_m / np.array([2.0, 11.9, 12.1, 5.0, 5.0])
    sigma_depth = np.array([0.1, 0.1, 0.1, 0.39, 0.41])
    depth = CAMERA.focal_px * CAMERA.baseline_m / disparity
    descriptor = np.eye(5, 64, dtype=np.float32)
    features = Features(
        np.full((5, 2), 300.0), disparity, sigma_depth * disparity / depth, descriptor
    )
    seen = observe(CAMERA, features, everything(features), FrontEndParameters())
    np.testing.assert_array_equal(seen.descriptor, descriptor[[0, 1, 3]])
    np.testing.assert_allclose(seen.uvd_px[:, 2], disparity[[0, 1, 3]], rtol=1e-6)
    keep = np.array([True, False, True, True, True])
    seen = observe(CAMERA, features, keep, FrontEndParameters())
    np.testing.assert_array_equal(seen.descriptor, descriptor[[0, 3]])
    with pytest.raises(ValueError, match=r"^keep:"):
        observe(CAMERA, features, keep[:3], FrontEndParameters())


@pytest.mark.parametrize("size", [(480, 640), (12, 16), (1, 1)])
def test_empty_images_yield_empty_observations(size: tuple[int, int]) -> None:
    camera = replace(CAMERA, height_px=size[0], width_px=size[1])
    for level in (0, 128, 255):
        image = np.full(size, level, np.uint8)
        features = FrontEnd(camera).extract(image, image)
        assert len(features) == 0
        tracks = Tracker(TrackParameters(), camera, 0.3).update(features)
        assert len(tracks.track_id) == 0
        assert len(observe(camera, features, everything(features), FrontEndParameters())) == 0


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("left", {"left": np.zeros((480, 640))}),
        ("left", {"left": np.zeros((480, 640, 3), np.uint8)}),
        ("right", {"right": np.zeros((240, 320), np.uint8)}),
    ],
)
def test_wrong_images_are_named(name: str, change: dict) -> None:
    image = np.zeros((480, 640), np.uint8)
    with pytest.raises(ValueError, match=f"^{name}:"):
        FrontEnd(CAMERA).extract(**({"left": image, "right": image} | change))


@pytest.mark.parametrize("name", ["sigma_uv_px", "max_depth_m", "max_sigma_depth_m"])
def test_wrong_parameters_are_named(name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name}:"):
        FrontEndParameters(**{name: 0.0})
