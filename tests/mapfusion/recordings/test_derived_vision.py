"""Settings that follow from a camera: the same disparities, whatever its metres."""

import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from mapfusion.recordings.derived_vision import derived_vision, with_window_for
from mapfusion.vision.frontend import FrontEndParameters


@pytest.mark.parametrize(("focal_px", "baseline_m"), [(577, 0.09), (707, 0.54), (300, 0.05)])
def test_depths_are_those_of_the_usual_disparities(focal_px: float, baseline_m: float) -> None:
    usual, head = FrontEndParameters(), StereoCamera()
    camera = StereoCamera(640, 480, focal_px, baseline_m)
    own = derived_vision(camera)
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
        with_window_for(vision, camera, np.full(9, depth)).usurf.side_m for depth in (3, 4, 7, 14)
    ]
    assert sides == pytest.approx([0.6, 0.6, 1.2, 2.4])
    assert with_window_for(vision, camera, np.empty(0)) is vision
