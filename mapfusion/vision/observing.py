"""Observations of a log, frame by frame: features that tracks have followed for long enough."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.robot_log import Observations
from mapfusion.se2 import Float
from mapfusion.vision.features import Features
from mapfusion.vision.frontend import FrontEndParameters, observable, observe
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
        lasting = self.tracker.landmarks(tracks)
        own = replace(found, uv_px=tracks.uv_px, disparity_px=tracks.disparity_px)
        rows = observable(self.camera, own, lasting, self.vision)
        observations = observe(self.camera, own, lasting, self.vision)
        track = tracks.track_id[rows]
        return ObservedFrame(tracks, rows, replace(observations, track=track))


def joined(frames: Sequence[Observations]) -> tuple[np.ndarray, Observations]:
    """Iterations (N,) and observations of a whole log from those of its frames."""
    iteration = np.repeat(np.arange(len(frames)), [len(own) for own in frames])
    names = ("position_m", "covariance_m2", "descriptor", "uvd_px", "track")
    return iteration, Observations(
        **{name: np.concatenate([getattr(own, name) for own in frames]) for name in names}
    )
