"""The front end's settings for a camera that nobody has tuned it for.

What the defaults of `FrontEndParameters` say in metres was chosen for one head: what is meant are
disparities and shares of the image. Here they are turned into metres of another camera, and the
described window spans what it spans there at the depths that are seen.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.se2 import Float
from mapfusion.vision.frontend import FrontEnd, FrontEndParameters

_USUAL = StereoCamera()  # the head that the defaults are for
_USUAL_DEPTH_M = 3.5  # where that head's robots see walls, median
_ROBOT_STEP = 4.0  # others move more between two pictures than 0.1 m: a car 1.2 m


def derived_vision(camera: StereoCamera) -> FrontEndParameters:
    """Settings by the camera alone: depths by disparity, shifts by the image's size."""
    usual = FrontEndParameters()
    scale = camera.focal_px * camera.baseline_m / (_USUAL.focal_px * _USUAL.baseline_m)
    wide = camera.width_px / _USUAL.width_px
    stereo = replace(
        usual.stereo,
        min_depth_m=usual.stereo.min_depth_m * scale / max(wide, 1.0),
        max_depth_m=usual.stereo.max_depth_m * scale,
        nearest_plane_m=usual.stereo.nearest_plane_m * camera.baseline_m / _USUAL.baseline_m,
    )
    tracks = replace(
        usual.tracks,
        max_shift_u_px=usual.tracks.max_shift_u_px * wide,
        max_shift_v_px=usual.tracks.max_shift_v_px
        * _ROBOT_STEP
        * camera.height_px
        / _USUAL.height_px,
        max_disparity_ratio=usual.tracks.max_disparity_ratio**_ROBOT_STEP,
    )
    return replace(
        usual,
        stereo=stereo,
        tracks=tracks,
        max_depth_m=usual.max_depth_m * scale,
        max_sigma_depth_m=usual.max_sigma_depth_m * scale,
    )


def with_window_for(
    vision: FrontEndParameters, camera: StereoCamera, depth_m: Float
) -> FrontEndParameters:
    """With a described window that suits depths (N,) that were seen; as it is where none were.

    The side is the default's times a power of two, so that robots of one kind in like places
    describe alike.
    """
    if not len(depth_m):
        return vision
    side_m = vision.usurf.side_m * (np.median(depth_m) / _USUAL_DEPTH_M)
    side_m *= _USUAL.focal_px / camera.focal_px
    steps = float(np.round(np.log2(side_m / vision.usurf.side_m)))
    side_m = min(max(vision.usurf.side_m * 2.0**steps, 0.01), 10.0)  # what the setting allows
    return replace(vision, usurf=replace(vision.usurf, side_m=side_m))


def seen_depths(
    camera: StereoCamera,
    vision: FrontEndParameters,
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
) -> Float:
    """Depths (N,) of the corners matched in some rectified pairs."""
    front_end = FrontEnd(camera, vision)
    disparity = [front_end.extract(*pair).disparity_px for pair in pairs]
    return camera.focal_px * camera.baseline_m / np.concatenate([*disparity, np.empty(0)])
