"""The front end's settings for a camera and surroundings that nobody has tuned it for.

What the defaults of `FrontEndParameters` say in metres was chosen for one head: what is meant are
disparities and shares of the image, and these are turned into metres of another camera. All else is
measured on the recording's own pictures: depths, what true surfaces differ by in two pictures
(`noise_model.py`), how many corners it takes, and how far true points stray from frame to frame.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.se2 import Float
from mapfusion.vision.features import Features
from mapfusion.vision.frontend import FrontEnd, FrontEndParameters
from mapfusion.vision.noise_model import limits_for, measured_noise
from mapfusion.vision.observing import Observer
from mapfusion.vision.tracks import Tracks

Pair = tuple[np.ndarray, np.ndarray]

_USUAL = StereoCamera()  # the head that the defaults are for
_USUAL_DEPTH_M = 3.5  # where that head's robots see walls, median
# By how much farther others go between two pictures, as a share of the depth, than robots that see
# walls at 3.5 m in steps of 0.1 m: a car's 1.2 m at a median of 21 m is twice as much, and the
# nearer half of what it sees another two times.
_ROBOT_STEP = 4.0
_AREA_PX = 300  # of the image for one corner at most: they keep 10 px apart, on texture
_MOST_CORNERS = 5000  # that the setting allows
# Share of true surfaces that keep all limits: a choice of how many to give up for those near edges,
# whose two pictures differ for another reason than noise. What passes is held against SGBM on KITTI
# (tests/mapfusion/recordings/test_real_recordings.py: 97 % within a pixel, 300 a frame).
_TRUE_SHARE = 0.8
_WANTED = 100  # observations a frame: a filter's step takes as long as it has of them
_MEDIAN_ERROR = 0.6745  # of a normal variable, in standard deviations
_SIDE_M = (0.01, 10.0)  # of the described window, what the setting allows


def derived_vision(camera: StereoCamera) -> FrontEndParameters:
    """Settings by the camera alone: depths by disparity, shifts and corners by the image's size."""
    usual = FrontEndParameters()
    scale = camera.focal_px * camera.baseline_m / (_USUAL.focal_px * _USUAL.baseline_m)
    wide, high = camera.width_px / _USUAL.width_px, camera.height_px / _USUAL.height_px
    corners = camera.width_px * camera.height_px // _AREA_PX
    stereo = replace(
        usual.stereo,
        min_depth_m=usual.stereo.min_depth_m * scale / max(wide, 1.0),
        max_depth_m=usual.stereo.max_depth_m * scale,
        nearest_plane_m=usual.stereo.nearest_plane_m * camera.baseline_m / _USUAL.baseline_m,
    )
    tracks = replace(
        usual.tracks,
        max_shift_u_px=usual.tracks.max_shift_u_px * wide,
        max_shift_v_px=usual.tracks.max_shift_v_px * _ROBOT_STEP * high,
        max_disparity_ratio=usual.tracks.max_disparity_ratio**_ROBOT_STEP,
    )
    return replace(
        usual,
        harris=replace(usual.harris, max_corners=min(max(corners, 1), _MOST_CORNERS)),
        stereo=stereo,
        tracks=tracks,
        max_depth_m=usual.max_depth_m * scale,
        max_sigma_depth_m=usual.max_sigma_depth_m * scale,
    )


def measured_vision(
    camera: StereoCamera, apart: Sequence[Pair], run: Sequence[Pair]
) -> FrontEndParameters:
    """Settings by the camera and by what a recording shows.

    Args:
        camera: the rectified pair.
        apart: pairs (H, W) uint8 from all over the recording.
        run: pairs that follow one another, for what tracks do.
    """
    vision = derived_vision(camera)
    noise = measured_noise(apart, camera, vision.harris, vision.stereo)
    if noise is not None:
        stereo = limits_for(vision.stereo, noise, _TRUE_SHARE)
        tracks = replace(
            vision.tracks,
            noise_grey=noise.noise_grey,
            max_misfit_px=max(vision.tracks.max_misfit_px, noise.misfit_px),
        )
        vision = replace(vision, stereo=stereo, tracks=tracks)
    front_end = FrontEnd(camera, vision)
    depth_m = [
        camera.focal_px * camera.baseline_m / front_end.extract(*pair).disparity_px
        for pair in apart
    ]
    vision = with_window_for(vision, camera, np.concatenate([*depth_m, np.empty(0)]))
    front_end = FrontEnd(camera, vision)
    return _by_tracks(camera, vision, [front_end.extract(*pair) for pair in run])


def with_window_for(
    vision: FrontEndParameters, camera: StereoCamera, depth_m: Float
) -> FrontEndParameters:
    """With a described window that suits depths (N,) that were seen; as it is where none were.

    The side is the default's times a power of two, so that robots of one kind in like places
    describe alike.
    """
    if not len(depth_m):
        return vision
    usual_m = vision.usurf.side_m
    fits = np.median(depth_m) / _USUAL_DEPTH_M * _USUAL.focal_px / camera.focal_px
    side_m = usual_m * 2.0 ** float(np.round(np.log2(fits)))
    return replace(vision, usurf=replace(vision.usurf, side_m=float(np.clip(side_m, *_SIDE_M))))


def _by_tracks(
    camera: StereoCamera, vision: FrontEndParameters, frames: Sequence[Features]
) -> FrontEndParameters:
    """With as many corners as give the observations wanted, and noise as tracks have it."""
    observer = Observer.of(camera, vision)
    seen = [observer.observe(found).tracks for found in frames]
    strays = [
        strays_px(camera, before, after)
        for before, after in itertools.pairwise(seen)
        if after.motion is not None
    ]
    if strays:
        # half of the errors lie within 0.67 deviations; two frames have a share in each
        sigma_px = float(np.median(np.abs(np.concatenate(strays)))) / _MEDIAN_ERROR / np.sqrt(2)
        vision = replace(vision, sigma_uv_px=float(max(vision.sigma_uv_px, sigma_px)))
    observer = Observer.of(camera, vision)
    lasting = [len(observer.observe(found).rows) for found in frames]
    usual = np.median(lasting[vision.tracks.min_length - 1 :] or [0])
    if usual > _WANTED:
        corners = int(vision.harris.max_corners * _WANTED / usual)
        vision = replace(vision, harris=replace(vision.harris, max_corners=corners))
    return vision


def strays_px(camera: StereoCamera, before: Tracks, after: Tracks) -> Float:
    """By how much points of the tracks lie beside where the motion takes them (2N,), u and v.

    Only where a motion is known.
    """
    assert after.motion is not None
    _, old, new = np.intersect1d(before.track_id, after.track_id, return_indices=True)
    p_after, _ = camera.triangulate(after.uv_px[new], after.disparity_px[new], 1.0, 1.0)
    T = after.motion.T_before_after
    moved = camera.project(p_after @ T[:3, :3].T + T[:3, 3])
    return (moved[:, :2] - before.uv_px[old]).ravel()
