"""Visual front end: stereo pairs in, landmark observations out."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from mapfusion.geometry.camera import StereoCamera
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import Range, require_in_range
from mapfusion.robot_log import Observations
from mapfusion.vision.harris import HarrisParameters, detect
from mapfusion.vision.stereo import MatchStatus, StereoParameters, match
from mapfusion.vision.surf import USurfParameters, describe
from mapfusion.vision.tracking import Features, Tracker, TrackParameters, Tracks, cut_patches


@dataclass(frozen=True)
class FrontEndParameters:
    """All the front end's parameters.

    Attributes:
        harris, stereo, usurf, tracks: of the parts.
        sigma_uv_px: standard deviation of the place of a track's point in an image, each axis.
        max_depth_m: points farther away are tracked but not observed: about as far as a room is
            long, since a robot that looks along it has nothing else to tell its heading by; what
            is farther away makes maps less certain and hardly tells more,
        max_sigma_depth_m: nor are points whose depth has a larger standard deviation.
    """

    harris: HarrisParameters = field(default_factory=HarrisParameters)
    stereo: StereoParameters = field(default_factory=StereoParameters)
    usurf: USurfParameters = field(default_factory=USurfParameters)
    tracks: TrackParameters = field(default_factory=TrackParameters)
    sigma_uv_px: Annotated[float, Range(1e-3, 100, "px")] = 0.08
    max_depth_m: Annotated[float, Range(0.1, 1000, "m")] = 12.0
    max_sigma_depth_m: Annotated[float, Range(1e-4, 1000, "m")] = 0.4

    def __post_init__(self) -> None:
        require_in_range(self)


@dataclass(frozen=True)
class FrontEnd:
    """Features of single stereo pairs; stateless, so frames may be done in any order."""

    camera: StereoCamera
    parameters: FrontEndParameters = field(default_factory=FrontEndParameters)

    def extract(self, left: np.ndarray, right: np.ndarray) -> Features:
        """Corners of the left image that have a match in the right one, described.

        Images are (H, W) uint8, rectified, of the camera's size.

        Raises:
            ValueError: wrong shape or type; names the argument.
        """
        size = (self.camera.height_px, self.camera.width_px)
        for name, image in (("left", left), ("right", right)):
            if image.shape != size or image.dtype != np.uint8:
                raise ValueError(f"{name}: is {image.dtype} {image.shape}, expected uint8 {size}")
        corners = detect(left, self.parameters.harris)
        matches = match(left, right, corners, self.camera, self.parameters.stereo)
        matched = matches.status == MatchStatus.MATCHED
        uv, disparity = corners[matched], matches.disparity_px[matched]
        depth = self.camera.focal_px * self.camera.baseline_m / disparity
        scale = self.parameters.usurf.scales_px(depth, self.camera.focal_px)
        descriptor = describe(left, uv, scale)
        sigma, slope = matches.sigma_px[matched], matches.slope[matched]
        return Features(uv, disparity, sigma, descriptor, slope, cut_patches(left, uv))


def observable(
    camera: StereoCamera,
    disparity_px: Float,
    sigma_px: Float,
    keep: np.ndarray,
    parameters: FrontEndParameters,
) -> np.ndarray:
    """Rows of the disparities (N,) marked in `keep` (N,) bool that are near and certain enough.

    `sigma_px` (N,) are their standard deviations.

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
    """What one frame adds to a log.

    Attributes:
        tracks: of all its features.
        rows: (N,) which of them are observed.
        observations: N of them, with their tracks.
    """

    tracks: Tracks
    rows: np.ndarray
    observations: Observations


@dataclass(frozen=True)
class Observer:
    """Follows features over frames, which come in their order, and tells what is observed.

    Attributes:
        tracker: what has been followed so far.
        camera: the rectified pair.
        vision: depths and noise of observations.
    """

    tracker: Tracker
    camera: StereoCamera
    vision: FrontEndParameters

    @classmethod
    def of(cls, camera: StereoCamera, vision: FrontEndParameters) -> "Observer":
        """One that has seen nothing yet."""
        return cls(Tracker(vision.tracks, camera, vision.sigma_uv_px), camera, vision)

    def observe(
        self, found: Features, steps: float = 1.0, R_after_before: Float | None = None
    ) -> ObservedFrame:
        """The next frame's observations; other arguments as `Tracker.update` has them."""
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
        )
        return ObservedFrame(tracks, rows, observations)


def concatenate_observations(frames: Sequence[Observations]) -> tuple[np.ndarray, Observations]:
    """Iterations (N,) and observations of a whole log from those of its frames."""
    iteration = np.repeat(np.arange(len(frames)), [len(own) for own in frames])
    names = ("position_m", "covariance_m2", "descriptor", "uvd_px", "track")
    return iteration, Observations(
        **{name: np.concatenate([getattr(own, name) for own in frames]) for name in names}
    )
