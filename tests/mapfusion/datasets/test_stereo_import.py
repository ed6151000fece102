"""Front-end settings scale with the camera and keep their disparities."""

import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from mapfusion.datasets.stereo_import import (
    front_end_for_camera,
    reprojection_errors_px,
    scale_descriptor_window,
)
from mapfusion.geometry import se3
from mapfusion.vision.front_end import FrontEndParameters
from mapfusion.vision.tracking import Tracks
from mapfusion.vision.visual_odometry import RigidMotion


@pytest.mark.parametrize(("focal_px", "baseline_m"), [(577, 0.09), (707, 0.54), (300, 0.05)])
def test_depths_are_those_of_the_usual_disparities(focal_px: float, baseline_m: float) -> None:
    usual, head = FrontEndParameters(), StereoCamera()
    camera = StereoCamera(640, 480, focal_px, baseline_m)
    own = front_end_for_camera(camera)
    for mine, theirs in (
        (own.max_depth_m, usual.max_depth_m),
        (own.stereo.min_depth_m, usual.stereo.min_depth_m),
        (own.stereo.max_depth_m, usual.stereo.max_depth_m),
    ):
        disparity = camera.focal_px * camera.baseline_m / mine
        assert disparity == pytest.approx(head.focal_px * head.baseline_m / theirs)


def test_the_window_doubles_with_the_depths_that_are_seen() -> None:
    camera, vision = StereoCamera(), FrontEndParameters()
    sides = [
        scale_descriptor_window(vision, camera, np.full(9, depth)).usurf.side_m
        for depth in (3, 4, 7, 14)
    ]
    assert sides == pytest.approx([0.6, 0.6, 1.2, 2.4])
    assert scale_descriptor_window(vision, camera, np.empty(0)) is vision


def test_what_tracks_stray_is_the_noise_of_their_places() -> None:
    rng, camera, n = np.random.default_rng(0), StereoCamera(), 4000
    T = se3.pose(np.eye(3), [0.1, 0.0, 0.0])
    p_after = rng.uniform((3, -1, 0), (6, 1, 1), (n, 3))
    noise = 0.3
    uvd = [camera.project(p) for p in (p_after + T[:3, 3], p_after)]
    order = rng.permutation(n)  # a frame has its features in an order of its own
    motion = RigidMotion(T, np.eye(6), n)
    before, after = (
        Tracks(rows, rows, seen[rows, :2] + noise * rng.standard_normal((n, 2)), seen[rows, 2], own)
        for rows, seen, own in ((np.arange(n), uvd[0], None), (order, uvd[1], motion))
    )
    strays = reprojection_errors_px(camera, before, after)
    assert len(strays) == 2 * n
    # the motion hardly scales the picture: two frames have an equal share in what strays
    assert np.std(strays) == pytest.approx(np.sqrt(2) * noise, rel=0.04)
