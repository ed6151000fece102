"""Levelling of a recording: camera mount, floor plane, and the attitude of each frame."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mapfusion.attitude import Attitude, transform_observations
from mapfusion.datasets.camera_calibration import R_ROBOT_OPTICAL
from mapfusion.datasets.formats import Level
from mapfusion.datasets.imu import SHARED_RAD, Inertial
from mapfusion.geometry import se3
from mapfusion.geometry.camera import StereoCamera
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se3 import inverse, pose, roll_pitch
from mapfusion.parameters import Range, require_in_range
from mapfusion.robot_log import Observations
from mapfusion.vision.attitude_filter import Levelling, Measured
from mapfusion.vision.features import Features
from mapfusion.vision.front_end import FrontEndParameters, Observer
from mapfusion.vision.visual_odometry import RigidMotion

_UP_TO_A_QUARTER = Range(-1.5, 1.5, "rad")  # a camera that looks straight up sees no walls


@dataclass(frozen=True)
class MountSettings:
    """Where the left camera is on the robot; what is None is as the recording has it.

    Attributes:
        x_m: ahead of the robot's middle.
        y_m: to its left.
        z_m: above the floor.
        roll_rad: about the axis ahead, the right side down.
        pitch_rad: about the axis to the left, looking down.
        yaw_rad: about the upright axis, looking to the left.
    """

    x_m: Annotated[float, Range(-10, 10, "m")] | None = None
    y_m: Annotated[float, Range(-10, 10, "m")] | None = None
    z_m: Annotated[float, Range(-10, 100, "m")] | None = None
    roll_rad: Annotated[float, _UP_TO_A_QUARTER] | None = None
    pitch_rad: Annotated[float, _UP_TO_A_QUARTER] | None = None
    yaw_rad: Annotated[float, _UP_TO_A_QUARTER] | None = None

    def __post_init__(self) -> None:
        require_in_range(self)

    def applied(self, T_robot_left: Float) -> Float:
        """A mount (4, 4) with what these settings replace; axes x ahead, y left, z up."""
        from scipy.spatial.transform import Rotation

        angles = Rotation.from_matrix(T_robot_left[:3, :3]).as_euler("ZYX")
        own = zip((self.yaw_rad, self.pitch_rad, self.roll_rad), angles, strict=True)
        turned = [theirs if ours is None else ours for ours, theirs in own]
        moved = [
            theirs if ours is None else ours
            for ours, theirs in zip(
                (self.x_m, self.y_m, self.z_m), T_robot_left[:3, 3], strict=True
            )
        ]
        if turned == angles.tolist():
            return pose(T_robot_left[:3, :3], moved)
        return pose(Rotation.from_euler("ZYX", turned).as_matrix(), moved)


def level_mount(baseline_m: float, x_m: float, z_m: float) -> Float:
    """T_robot_left (4, 4) of a pair that looks level ahead, its middle above the robot's axis."""
    return pose(np.eye(3), [x_m, baseline_m / 2, z_m])


def robot_in_body(T_body_camera: Float) -> tuple[Float, Float]:
    """The robot's frame where a recording has a body's, whose axes may lie in any order.

    The body's axes are renamed so that the camera looks ahead and stands upright, as nearly as the
    24 ways to name them allow; what remains is the mount.

    Args:
        T_body_camera: (4, 4) of the left camera in optical axes.

    Returns:
        T_body_robot (4, 4), and T_robot_left (4, 4) with x ahead, y left, z up.
    """
    from scipy.spatial.transform import Rotation

    ahead = T_body_camera @ inverse(pose(R_ROBOT_OPTICAL, np.zeros(3)))
    ways = np.rint(Rotation.create_group("O").as_matrix())
    nearest = ways[np.argmax(np.einsum("nij,ij->n", ways, ahead[:3, :3]))]
    T_body_robot = pose(nearest, np.zeros(3))
    return T_body_robot, inverse(T_body_robot) @ ahead


def levelled(observed: Observations, camera: StereoCamera, T_robot_left: Float) -> Observations:
    """Observations of a camera that was taken for a level one, where the mount truly has them."""
    R, t = T_robot_left[:3, :3], T_robot_left[:3, 3]
    if np.array_equal(R, np.eye(3)) and np.array_equal(t, camera.p_robot_left):
        return observed
    return transform_observations(observed, R, t - R @ camera.p_robot_left)


def upright(T_robot_left: Float, up_left: Float) -> Float:
    """A mount whose roll and pitch are such that a direction (3,) of the left camera is up."""
    from scipy.spatial.transform import Rotation

    up = T_robot_left[:3, :3] @ (up_left / np.linalg.norm(up_left))
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine == 0:
        return T_robot_left
    turn = Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[2])).as_matrix()
    return pose(turn @ T_robot_left[:3, :3], T_robot_left[:3, 3])


_LEAST_POINTS = 12  # four times as many as a plane has parameters
# Added to the points' own noise, in heights of the camera: from all below its middle to none.
_TOLERANCES = (0.3, 0.1, 0.03, 0.01, 0.0)
_STEPS = 3  # of the gate and the fit at each
_MOST_TILT = 0.35  # slope against the level, rad: what lies steeper is a wall
_MEDIAN_SQUARE = chi_square_bound(0.5, 1)  # of squared distances in standard deviations


@dataclass(frozen=True)
class Floor:
    """The plane z = slope_x x + slope_y y + height in the frame of the points.

    Attributes:
        plane: (3,) slope_x, slope_y, height in metres.
        covariance: (3, 3) of its error; as large as the residuals say, where these exceed what is
            stated of the points.
        n_points: that lie on it.
    """

    plane: Float
    covariance: Float
    n_points: int

    @property
    def attitude(self) -> tuple[Float, Float]:
        """Roll, pitch, height (3,) of the points' frame above the floor, and its sigma (3,)."""
        slope_x, slope_y, height_m = self.plane
        length = np.sqrt(1 + slope_x**2 + slope_y**2)
        value = [np.arctan(-slope_y), np.arcsin(slope_x / length), -height_m / length]
        sigma = np.sqrt(np.diag(self.covariance))
        return np.array(value), sigma[[1, 0, 2]]


def floor_of(points: Observations, camera_height_m: float, probability: float) -> Floor | None:
    """The floor among points (N, 3), z up from where it about is.

    Weighted least squares of the points' heights over those inside a gate, again and again, while a
    tolerance that is added to their noise falls from a third of the camera's height to nothing:
    what stands on the floor drops out on the way.

    Args:
        points: whatever is seen, with covariances.
        camera_height_m: above the floor; points above half of it are no floor.
        probability: of the gate.

    Returns:
        None where fewer than a dozen points lie on one plane that is about level.
    """
    position, covariance = points.position_m, points.covariance_m2
    low = position[:, 2] < camera_height_m / 2
    position, covariance = position[low], covariance[low]
    if len(position) < _LEAST_POINTS:
        return None
    design = np.column_stack([position[:, :2], np.ones(len(position))])
    plane, normal, square = np.zeros(3), np.eye(3), np.zeros(len(position))
    inside = np.ones(len(position), dtype=bool)
    gate = chi_square_bound(probability, 1)
    for tolerance in _TOLERANCES:
        for _ in range(_STEPS):
            across = np.array([-plane[0], -plane[1], 1.0])
            own = np.einsum("i,nij,j->n", across, covariance, across)
            variance = own + (tolerance * camera_height_m) ** 2
            square = (position[:, 2] - design @ plane) ** 2 / variance
            inside = square <= gate
            if inside.sum() < _LEAST_POINTS:
                return None
            weighted = design[inside] / variance[inside, None]
            normal = weighted.T @ design[inside]
            if np.linalg.matrix_rank(normal) < len(plane):  # all on one line
                return None
            plane = np.linalg.solve(normal, weighted.T @ position[inside, 2])
    if np.hypot(plane[0], plane[1]) > np.tan(_MOST_TILT):
        return None
    excess = max(float(np.median(square[inside])) / _MEDIAN_SQUARE, 1.0)
    covariance = np.array(excess * np.linalg.inv(normal), dtype=np.float64)
    return Floor(plane, covariance, int(inside.sum()))


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
