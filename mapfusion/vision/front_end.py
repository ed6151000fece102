"""Visual front end: landmark observations from stereo pairs, or from images with depths."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.descriptors import USURF
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import Range, require_in_range
from mapfusion.robot_log import Observations
from mapfusion.vision.depth import DepthParameters, match_depth
from mapfusion.vision.descriptors import NamedDescriber, target_of
from mapfusion.vision.harris import HarrisParameters, detect
from mapfusion.vision.stereo import MatchStatus, StereoParameters, match
from mapfusion.vision.surf import USurfParameters
from mapfusion.vision.tracking import Features, Tracker, TrackParameters, Tracks, cut_patches


@dataclass(frozen=True)
class FrontEndParameters:
    """Parameters of the front end.

    Attributes:
        harris, stereo, tracks: parameters of the parts.
        descriptor: name of the descriptor: `usurf` (the paper's), `sift`, `orb`, that of a plug-in,
            or `FILE.py:CLASS`.
        usurf: window of the descriptor, whichever it is.
        sigma_uv_px: standard deviation of the position of a track's point along each image axis.
        max_depth_m: largest depth of an observed point; farther points are tracked only. The
            default is about the length of a room, so that a robot that looks along the room still
            observes its heading. Farther points add uncertainty but little information.
        max_sigma_depth_m: largest standard deviation of the depth of an observed point.
    """

    harris: HarrisParameters = field(default_factory=HarrisParameters)
    stereo: StereoParameters = field(default_factory=StereoParameters)
    descriptor: str = USURF.name
    usurf: USurfParameters = field(default_factory=USurfParameters)
    tracks: TrackParameters = field(default_factory=TrackParameters)
    sigma_uv_px: Annotated[float, Range(1e-3, 100, "px")] = 0.08
    max_depth_m: Annotated[float, Range(0.1, 1000, "m")] = 12.0
    max_sigma_depth_m: Annotated[float, Range(1e-4, 1000, "m")] = 0.4

    def __post_init__(self) -> None:
        require_in_range(self)
        target_of(self.descriptor)


@dataclass(frozen=True)
class FrontEnd:
    """Feature extraction from single pairs, without state: frames may come in any order.

    Attributes:
        camera: the rectified pair.
        parameters: parameters of the parts.
        depth: noise and tests of depth images, which take the place of the right images; None for
            stereo pairs.
    """

    camera: StereoCamera
    parameters: FrontEndParameters = field(default_factory=FrontEndParameters)
    depth: DepthParameters | None = None

    def extract(self, left: np.ndarray, right: np.ndarray) -> Features:
        """Detect corners of the left image, match them in the right image and describe them.

        Images are (H, W) uint8, rectified, of the camera's size. Depth images in the place of right
        ones are float32, in metres.

        Raises:
            ValueError: wrong shape or type; names the argument.
        """
        size = (self.camera.height_px, self.camera.width_px)
        for name, image in (("left", left), ("right", right)):
            kind = np.float32 if name == "right" and self.depth is not None else np.uint8
            if image.shape != size or image.dtype != kind:
                found = f"is {image.dtype} {image.shape}"
                raise ValueError(f"{name}: {found}, expected {np.dtype(kind)} {size}")
        corners = detect(left, self.parameters.harris)
        if self.depth is None:
            matches = match(left, right, corners, self.camera, self.parameters.stereo)
        else:
            matches = match_depth(right, corners, self.camera, self.depth)
        matched = matches.status == MatchStatus.MATCHED
        uv, disparity = corners[matched], matches.disparity_px[matched]
        depth = self.camera.focal_px * self.camera.baseline_m / disparity
        scale = self.parameters.usurf.scales_px(depth, self.camera.focal_px)
        descriptor, kind = self._describer.describe(left, uv, scale)
        sigma, slope = matches.sigma_px[matched], matches.slope[matched]
        return Features(uv, disparity, sigma, descriptor, slope, cut_patches(left, uv), kind)

    @cached_property
    def _describer(self) -> NamedDescriber:
        return NamedDescriber(self.parameters.descriptor)


def observable(
    camera: StereoCamera,
    disparity_px: Float,
    sigma_px: Float,
    keep: np.ndarray,
    parameters: FrontEndParameters,
) -> np.ndarray:
    """Select the points that are near and certain enough to be observed.

    Args:
        camera: the rectified pair.
        disparity_px: disparities, shape (N,).
        sigma_px: standard deviations of the disparities, shape (N,).
        keep: mask of the points to select from, shape (N,) bool.
        parameters: limits of depth and of its standard deviation.

    Returns:
        Indices of the selected points.

    Raises:
        ValueError: `keep` has another length than the disparities.
    """
    if keep.shape != disparity_px.shape:
        raise ValueError(f"keep: shape is {keep.shape}, expected {disparity_px.shape}")
    depth = camera.focal_px * camera.baseline_m / disparity_px
    sigma_depth = depth * sigma_px / disparity_px
    near = (depth <= parameters.max_depth_m) & (sigma_depth <= parameters.max_sigma_depth_m)
    return np.flatnonzero(keep & near)


@dataclass(frozen=True)
class ObservedFrame:
    """Tracks and observations of one frame.

    Attributes:
        tracks: tracks of all features.
        rows: indices of the observed features, shape (N,).
        observations: N observations with their tracks.
    """

    tracks: Tracks
    rows: np.ndarray
    observations: Observations


@dataclass(frozen=True)
class Observer:
    """Tracker of features over consecutive frames that returns the observations of each frame.

    Attributes:
        tracker: tracker with the state of the last frame.
        camera: the rectified pair.
        vision: limits of depth and noise of the observations.
    """

    tracker: Tracker
    camera: StereoCamera
    vision: FrontEndParameters

    @classmethod
    def of(cls, camera: StereoCamera, vision: FrontEndParameters) -> "Observer":
        """Make an observer before the first frame."""
        return cls(Tracker(vision.tracks, camera, vision.sigma_uv_px), camera, vision)

    def observe(
        self, found: Features, steps: float = 1.0, R_after_before: Float | None = None
    ) -> ObservedFrame:
        """Return the observations of the next frame; arguments as in `Tracker.update`."""
        tracks = self.tracker.update(found, steps, R_after_before)
        given = (tracks.disparity_px, found.sigma_disparity_px, self.tracker.landmarks(tracks))
        rows = observable(self.camera, *given, self.vision)
        position, covariance = (values[rows] for values in self.tracker.points_m)
        uvd = np.column_stack([tracks.uv_px[rows], tracks.disparity_px[rows]]).astype(np.float32)
        observations = Observations(
            position,
            covariance,
            found.descriptor[rows],
            uvd_px=uvd,
            track=tracks.track_id[rows],
            descriptor_kind=found.kind,
        )
        return ObservedFrame(tracks, rows, observations)


def concatenate_observations(frames: Sequence[Observations]) -> tuple[np.ndarray, Observations]:
    """Return iterations (N,) and observations of a log from the observations of its frames."""
    iteration = np.repeat(np.arange(len(frames)), [len(own) for own in frames])
    names = ("position_m", "covariance_m2", "descriptor", "uvd_px", "track")
    joined = {name: np.concatenate([getattr(own, name) for own in frames]) for name in names}
    kind = frames[0].descriptor_kind if frames else None
    if kind is not None and kind != USURF:
        kind = replace(kind, reference=None)  # that of all frames
    return iteration, Observations(**joined, descriptor_kind=kind)
