"""Observations of a log, frame by frame: features that tracks have followed for long enough."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.robot_log import Observations
from mapfusion.se2 import Float
from mapfusion.vision.features import Features
from mapfusion.vision.frontend import FrontEndParameters, observable
from mapfusion.vision.tracks import Tracker, Tracks


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


def joined(frames: Sequence[Observations]) -> tuple[np.ndarray, Observations]:
    """Iterations (N,) and observations of a whole log from those of its frames."""
    iteration = np.repeat(np.arange(len(frames)), [len(own) for own in frames])
    names = ("position_m", "covariance_m2", "descriptor", "uvd_px", "track")
    return iteration, Observations(
        **{name: np.concatenate([getattr(own, name) for own in frames]) for name in names}
    )
