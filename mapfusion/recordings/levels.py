"""Where a recording knows the attitude of its robot from, frame by frame."""

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.recordings.floor import floor_of
from mapfusion.recordings.inertial import SHARED_RAD, Inertial
from mapfusion.recordings.level import Level
from mapfusion.recordings.mount import levelled
from mapfusion.robot_log import Observations
from mapfusion.se2 import Float
from mapfusion.se3 import roll_pitch
from mapfusion.vision.attitude_filter import Measured
from mapfusion.vision.features import Features

# Standard deviations of a first frame's roll, pitch (rad) and height (m): a car on its springs
# stands within half a degree of the road, and its height is the map's.
_FIRST_SIGMA = np.array([0.01, 0.01, 0.0])
# Of an attitude that a trajectory tells, of which nobody says how good it is: an inclinometer's.
_TOLD_SIGMA_RAD, _TOLD_SIGMA_M = 0.0052, 0.02
_LEVEL_RAD = 1e-6  # a trajectory that tilts by less is one in the plane
_ON_THE_FLOOR = 0.99  # share of the floor's own points that its gate keeps
# Of a floor against the level, in all frames alike: roads fall off to their sides by 2 %, so that
# rain runs off.
_ROAD_RAD = 0.02


def known_from(wanted: Level, odometry: Float | None, inertial: Inertial | None = None) -> Level:
    """What `auto` stands for, by what was recorded of dead reckoning (T, 4, 4) and acceleration."""
    if wanted != "auto":
        return wanted
    if odometry is None:
        return "pictures" if inertial is None else "imu"
    tilts = np.abs(roll_pitch(odometry[:, :3, :3])).max() > _LEVEL_RAD
    return "odometry" if tilts else "mount"


class Levels:
    """What is measured of the attitude in each frame of a log.

    Args:
        known: where from; not `auto`.
        camera: the rectified pair, which was taken for level.
        T_robot_left: (4, 4) its mount.
        odometry: (T, 4, 4) dead reckoning at the frames, or None.
        tilts: (T, 2) roll and pitch by the accelerometer, NaN where it tells none, and (2,) their
            deviations; or None.
        counted: (T, 3) turns since the frame before by gyroscopes, NaN where they tell none, and
            (T,) the seconds since; or None.

    Attributes:
        camera, T_robot_left: as given.
    """

    def __init__(
        self,
        known: Level,
        camera: StereoCamera,
        T_robot_left: Float,
        odometry: Float | None,
        tilts: tuple[Float, Float] | None = None,
        counted: tuple[Float, Float] | None = None,
    ) -> None:
        self.camera, self.T_robot_left = camera, T_robot_left
        self._counted = counted
        self._known: Level = known
        self._odometry, self._tilts = odometry, tilts

    @property
    def measures(self) -> bool:
        """Whether the attitude is followed frame by frame; else the body is level."""
        return self._known != "mount"

    @property
    def shared_rad(self) -> float:
        """Standard deviation of what all measured tilts err by alike."""
        return {"imu": SHARED_RAD, "floor": _ROAD_RAD}.get(self._known, 0.0)

    def counted(self, k: int) -> tuple[Float, float] | None:
        """The turn (3,) since frame k - 1 by gyroscopes, and the seconds since; None: unknown."""
        if self._counted is None or np.isnan(self._counted[0][k]).any():
            return None
        return self._counted[0][k], float(self._counted[1][k])

    def measured(self, k: int, found: Features, sigma_uv_px: float) -> Measured:
        """Of frame k, in which these features were found."""
        if self._known == "odometry":
            assert self._odometry is not None
            T = self._odometry[k]
            told = [*roll_pitch(T[:3, :3]), T[2, 3] - self._odometry[0, 2, 3]]
            return Measured(np.array(told), np.array([_TOLD_SIGMA_RAD] * 2 + [_TOLD_SIGMA_M]))
        if self._known == "imu":
            assert self._tilts is not None
            value, sigma = self._tilts
            height = np.nan if k else 0.0  # the map's, and carried on
            return Measured(np.array([*value[k], height]), np.array([*sigma, 0.0]))
        seen = self._floor(found, sigma_uv_px) if self._known == "floor" else None
        if seen is not None:
            return seen
        # what the first frame takes for level is, but for how the body stands, the map's plane
        return Measured(np.full(3, np.nan if k else 0.0), _FIRST_SIGMA)

    def _floor(self, found: Features, sigma_uv_px: float) -> Measured | None:
        noise = (sigma_uv_px, found.sigma_disparity_px)
        points = Observations(*self.camera.triangulate(found.uv_px, found.disparity_px, *noise))
        points = levelled(points, self.camera, self.T_robot_left)
        floor = floor_of(points, float(self.T_robot_left[2, 3]), _ON_THE_FLOOR)
        return None if floor is None else Measured(*floor.attitude)
