"""Frames of a stereo recording, tracked and levelled one after the other."""

import numpy as np

from mapfusion import se3
from mapfusion.attitude import Attitude
from mapfusion.recordings.levels import Levels
from mapfusion.recordings.mount import levelled
from mapfusion.robot_log import Observations
from mapfusion.vision.features import Features
from mapfusion.vision.frontend import FrontEndParameters
from mapfusion.vision.levelling import Levelling
from mapfusion.vision.observing import Observer
from mapfusion.vision.rigid_links import RigidMotion


class LevelFrames:
    """What became of the frames so far.

    Args:
        vision: settings of the front end.
        levels: how the camera is mounted, and what is measured of its robot's attitude.

    Attributes:
        observed: each frame's observations in the level frame.
        motions: of the camera that was taken for level, since the frame before.
        linked: share of the features of the frame before that were found again; NaN at first.
    """

    def __init__(self, vision: FrontEndParameters, levels: Levels) -> None:
        self.observed: list[Observations] = []
        self.motions: list[RigidMotion | None] = []
        self.linked: list[float] = []
        self._levels, self._sigma_uv_px = levels, vision.sigma_uv_px
        camera = levels.camera
        taken = se3.pose(camera.camera_axes, camera.p_robot_left)
        self._levelling = Levelling(levels.T_robot_left @ se3.inverse(taken), levels.shared_rad)
        self._observer = Observer.of(camera, vision)
        self._before = 0

    @property
    def attitude(self) -> Attitude | None:
        """By which they were levelled; None for a body that is level."""
        return self._levelling.attitude if self._levels.measures else None

    def add(self, found: Features, steps: float) -> None:
        """The next frame; `steps` are usual steps of time since the one before."""
        levels = self._levels
        if levels.measures:
            k = len(self.observed)
            measured = levels.measured(k, found, self._sigma_uv_px)
            turn = self._levelling.expected_turn(measured)
            frame = self._observer.observe(found, steps, turn)
            self._levelling.add(frame.tracks.motion, measured, levels.counted(k))
            own = self._levelling.applied(frame.observations)
        else:
            frame = self._observer.observe(found, steps)
            own = levelled(frame.observations, levels.camera, levels.T_robot_left)
        again = float(np.sum(frame.tracks.length > 1)) / max(self._before, 1)
        self.linked.append(again if self.observed else np.nan)
        self._before = len(found)
        self.motions.append(frame.tracks.motion)
        self.observed.append(own)
