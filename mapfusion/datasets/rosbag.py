"""Stereo recordings in ROS 1 and ROS 2 bags.

Two topics of pictures (Image or CompressedImage) with a CameraInfo each, in the namespace of the
pictures as usual; optionally odometry (Odometry), an IMU (Imu) and true poses (Odometry,
PoseStamped and others). The static transforms of `/tf_static` tell how the left camera is mounted,
where they connect its frame to the robot's; measured gravity takes the place of their roll and
pitch.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from mapfusion.datasets.camera_calibration import (
    R_ROBOT_OPTICAL,
    Distortion,
    Lens,
    StereoCalibration,
)
from mapfusion.datasets.imu import ImuData
from mapfusion.datasets.levelling import MountSettings, level_mount, upright
from mapfusion.datasets.stereo_recording import ReadYaml, Shot, StereoRecording, pair_shots
from mapfusion.datasets.text_files import NS
from mapfusion.datasets.tum import TimedPoses
from mapfusion.errors import InputError, did_you_mean, one_line
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


_MOST_TOPICS = 12  # of a bag, named in a message


class Bag:
    """An open bag. Whatever is wrong with its bytes is an InputError that names it."""

    def __init__(self, path: Path) -> None:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        if not path.exists():
            raise InputError(f"{path}: no such file or folder (a ROS bag)")
        self.path = path
        try:
            # bags of ROS 2 that carry no definitions have those that have been there since Humble
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
        except Exception as error:  # the readers of several formats leave by any door
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> InputError:
        reason = one_line(str(error)) or type(error).__name__
        return InputError(f"{self.path}: damaged or no ROS bag ({reason})")

    @property
    def topics(self) -> dict[str, str]:
        """Type of each topic's messages."""
        return {each.topic: each.msgtype for each in self._reader.connections}

    def require(self, option: str, topic: str, *types: str) -> str:
        """The type of a topic.

        Raises:
            InputError: there is no such topic, or its type is none of these; names the option.
        """
        known = self.topics
        if topic not in known:
            named = ", ".join(sorted(known)[:_MOST_TOPICS]) or "none"
            meant = did_you_mean(topic, known)
            raise InputError(f"{self.path}: {option} {topic}: no such topic{meant}; there: {named}")
        if known[topic].rsplit("/", 1)[-1] not in types:
            wanted = " or ".join(types)
            found = f"holds {known[topic]}, expected {wanted}"
            raise InputError(f"{self.path}: {option} {topic}: {found}")
        return known[topic]

    def messages(self, topic: str, at_ns: int | None = None) -> Iterator[tuple[int, Any]]:
        """When each message of a topic was recorded (ns), and the message; only those of a time."""
        own: list[Connection] = [each for each in self._reader.connections if each.topic == topic]
        stop = None if at_ns is None else at_ns + 1
        try:
            for connection, time_ns, data in self._reader.messages(own, at_ns, stop):
                yield time_ns, self._reader.deserialize(data, connection.msgtype)
        except InputError:
            raise
        except Exception as error:
            raise self._damaged(error) from error

    def first(self, topic: str) -> Any:
        """The first message of a topic; raises InputError where there is none."""
        for _, message in self.messages(topic):
            return message
        raise InputError(f"{self.path}: topic {topic} holds no message")


def stamp_ns(message: Any) -> int:
    """When a message says that it was measured."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS + int(stamp.nanosec)


# Encoding: type of a channel, channels, and how OpenCV makes grey of it.
_ENCODINGS: dict[str, tuple[type, int, int | None]] = {
    "mono8": (np.uint8, 1, None),
    "8UC1": (np.uint8, 1, None),
    "mono16": (np.uint16, 1, None),
    "16UC1": (np.uint16, 1, None),
    "rgb8": (np.uint8, 3, cv2.COLOR_RGB2GRAY),
    "bgr8": (np.uint8, 3, cv2.COLOR_BGR2GRAY),
    "8UC3": (np.uint8, 3, cv2.COLOR_BGR2GRAY),
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2GRAY),
    "bgra8": (np.uint8, 4, cv2.COLOR_BGRA2GRAY),
    # ROS names the first two pixels of the first row, OpenCV those of the second.
    "bayer_rggb8": (np.uint8, 1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (np.uint8, 1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (np.uint8, 1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (np.uint8, 1, cv2.COLOR_BayerGB2GRAY),
}
_DISTORTIONS: dict[str, Distortion] = {
    "plumb_bob": "radial-tangential",
    "rational_polynomial": "radial-tangential",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "": "none",
    "none": "none",
}


def decode_image(message: Any) -> np.ndarray:
    """Grey levels (H, W), uint8 or uint16, of an Image or a CompressedImage.

    Raises:
        InputError: an encoding that is not read, or too few bytes.
    """
    if not hasattr(message, "encoding"):
        image = cv2.imdecode(np.asarray(message.data, np.uint8), cv2.IMREAD_ANYDEPTH)
        if image is None:
            raise InputError("compressed picture: cannot be decoded")
        return image
    if message.encoding not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise InputError(f"encoding {message.encoding!r}: is not read; known: {known}")
    kind, channels, conversion = _ENCODINGS[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    own = width * channels * np.dtype(kind).itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if not 0 < own <= step or len(data) < height * step:
        raise InputError(f"picture of {width}x{height}: has {len(data)} bytes, rows of {step}")
    order = ">" if message.is_bigendian else "<"
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :own])
    levels = rows.view(np.dtype(kind).newbyteorder(order)).astype(kind)
    levels = levels.reshape((height, width, channels) if channels > 1 else (height, width))
    return levels if conversion is None else cv2.cvtColor(levels, conversion)


def stereo_calibration(left: Any, right: Any, rectified: bool) -> StereoCalibration:
    """The pair that two CameraInfo messages tell, of raw pictures or of rectified ones.

    Raises:
        InputError: no stereo pair, or a lens that is not read.
    """
    P_right = _matrix(right, "P", (3, 4))
    if not P_right[0, 0] > 0:
        raise InputError("camera_info: the right camera's P holds no focal length")
    baseline_m = -P_right[0, 3] / P_right[0, 0]
    if not baseline_m > 0:
        told = "the right camera's P holds no baseline"
        raise InputError(f"camera_info: {told}; are the cameras a pair, and not exchanged?")
    apart = se3.pose(np.eye(3), [baseline_m, 0.0, 0.0])
    if rectified:
        return StereoCalibration(_rectified(left), _rectified(right), apart)
    turned = [se3.pose(_matrix(info, "R", (3, 3)), np.zeros(3)) for info in (left, right)]
    T_left_right = se3.inverse(turned[0]) @ apart @ turned[1]
    return StereoCalibration(_raw(left), _raw(right), T_left_right)


def pose_of_message(message: Any) -> Float:
    """A pose (4, 4) of an Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped."""
    if hasattr(message, "transform"):
        t, q = message.transform.translation, message.transform.rotation
    else:
        own = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        t, q = own.position, own.orientation
    xyzw = np.array([q.x, q.y, q.z, q.w])
    if not np.linalg.norm(xyzw) > 0:
        raise InputError("a pose has a quaternion of length 0")
    return se3.from_quaternions([t.x, t.y, t.z], xyzw)


def lookup_transform(transforms: list[Any], target: str, source: str) -> Float | None:
    """T_target_source (4, 4) through a tree of TransformStamped; None where it leads nowhere."""
    parent = {
        _frame(t.child_frame_id): (_frame(t.header.frame_id), pose_of_message(t))
        for t in transforms
    }
    up, lines = [_line(parent, _frame(name)) for name in (target, source)], None
    for frame, T_frame_source in up[1].items():
        if frame in up[0]:
            lines = se3.inverse(up[0][frame]) @ T_frame_source
            break
    return lines


def _line(parent: dict[str, tuple[str, Float]], frame: str) -> dict[str, Float]:
    """Of each frame above one, nearest first, T_above_frame."""
    found, T = {frame: np.eye(4)}, np.eye(4)
    while frame in parent and parent[frame][0] not in found:
        frame, T_above = parent[frame]
        T = T_above @ T
        found[frame] = T
    return found


def _frame(name: str) -> str:
    return name.removeprefix("/")


def _matrix(info: Any, name: str, shape: tuple[int, int]) -> Float:
    """K, D, R and P, which ROS 2 writes small."""
    return _numbers(info, name).reshape(shape)


def _numbers(info: Any, name: str) -> Float:
    values = getattr(info, name, None)
    return np.asarray(getattr(info, name.lower()) if values is None else values, np.float64)


def _size(info: Any) -> tuple[int, int]:
    return int(info.width), int(info.height)


def _rectified(info: Any) -> Lens:
    P = _matrix(info, "P", (3, 4))
    return Lens(_size(info), (P[0, 0], P[1, 1]), (P[0, 2], P[1, 2]))


def _raw(info: Any) -> Lens:
    K, model = _matrix(info, "K", (3, 3)), str(info.distortion_model)
    if model not in _DISTORTIONS:
        known = ", ".join(name for name in _DISTORTIONS if name)
        raise InputError(f"camera_info: distortion_model {model!r} is unknown; known: {known}")
    coefficients = _numbers(info, "D")
    if model == "rational_polynomial" and not coefficients[5:].any():
        coefficients = coefficients[:5]
    distortion = _DISTORTIONS[model] if coefficients.any() else "none"
    own = tuple(coefficients.tolist()) if distortion != "none" else ()
    return Lens(_size(info), (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), distortion, own)


_PICTURES = ("Image", "CompressedImage")
_POSES = ("Odometry", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")
_HEIGHT_M = 0.5  # of a camera whose mount nobody tells; it moves all heights alike


@dataclass(frozen=True)
class RosbagSettings:
    """Which topics of a bag are what.

    Attributes:
        left: pictures of the left camera.
        right: of the right one.
        odom: dead reckoning of the robot; none: the pictures tell.
        imu: accelerations, whose mean over the recording is up, and which level each frame; none:
            the mount is as transforms tell.
        truth: true poses of the robot; none: unknown.
        left_info: calibration of the left camera; by default `camera_info` beside its pictures.
        right_info: of the right one.
        rectified: whether the pictures are; by default when their topics' names hold `rect`.
        base: the robot's frame, x ahead and z up, in `/tf_static`.
        mount: what replaces the mount that is recorded.
    """

    left: str = "/left/image_raw"
    right: str = "/right/image_raw"
    odom: str = ""
    imu: str = ""
    truth: str = ""
    left_info: str = ""
    right_info: str = ""
    rectified: bool | None = None
    base: str = "base_link"
    mount: MountSettings = field(default_factory=MountSettings)


@dataclass(frozen=True)
class _Message:
    """A picture in a bag; calling it reads it."""

    bag: Bag
    topic: str
    recorded_ns: int
    stamp_ns: int

    def __call__(self) -> np.ndarray:
        for _, message in self.bag.messages(self.topic, self.recorded_ns):
            if stamp_ns(message) == self.stamp_ns:
                try:
                    return decode_image(message)
                except InputError as error:
                    raise InputError(
                        f"{self.bag.path}: {self.topic} at {self.stamp_ns} ns: {error}"
                    ) from error
        raise InputError(f"{self.bag.path}: {self.topic}: the picture of {self.stamp_ns} is gone")


def read_rosbag(path: Path, settings: RosbagSettings, _: ReadYaml) -> StereoRecording:
    """Read a bag; pictures are loaded later.

    Raises:
        InputError: the bag is damaged, or lacks a topic; names bag and topic.
    """
    bag = Bag(path)
    topics = (settings.left, settings.right)
    for option, topic in zip(("--left", "--right"), topics, strict=True):
        bag.require(option, topic, *_PICTURES)
    for option, topic in (("--odom", settings.odom), ("truth", settings.truth)):
        if topic:
            bag.require(option, topic, *_POSES)
    if settings.imu:
        bag.require("--imu", settings.imu, "Imu")
    pair = _calibration(bag, settings)
    left, right = (_shots(bag, topic) for topic in topics)
    try:
        time_ns, pictures, dropped = pair_shots(left, right)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    T_robot_left, felt = _mount(bag, settings, pair)
    T_robot_left = settings.mount.applied(T_robot_left)
    odometry, truth = (
        _poses(bag, topic) if topic else None for topic in (settings.odom, settings.truth)
    )
    return StereoRecording(
        path.resolve().stem,
        time_ns,
        pictures,
        pair,
        T_robot_left,
        truth,
        odometry,
        dropped,
        felt,
        f"{path}: camera_info of {settings.left} and {settings.right}",
    )


def _calibration(bag: Bag, settings: RosbagSettings) -> StereoCalibration:
    pictures = (settings.left, settings.right)
    given = (settings.left_info, settings.right_info)
    infos = []
    for option, topic, own in zip(("left_info", "right_info"), pictures, given, strict=True):
        beside = own or f"{topic.rsplit('/', 1)[0]}/camera_info"
        bag.require(option, beside, "CameraInfo")
        infos.append(bag.first(beside))
    rectified = settings.rectified
    if rectified is None:
        rectified = all("rect" in topic for topic in pictures)
    try:
        return stereo_calibration(infos[0], infos[1], rectified)
    except (InputError, ValueError) as error:
        raise InputError(f"{bag.path}: {error}") from error


def _shots(bag: Bag, topic: str) -> list[Shot]:
    shots, last_ns = list[Shot](), None
    for recorded_ns, message in bag.messages(topic):
        own_ns = stamp_ns(message)
        if last_ns is not None and own_ns <= last_ns:
            back = f"{(last_ns - own_ns) / 1e9:g} s"
            told = f"the picture recorded at {recorded_ns} ns runs back by {back}"
            raise InputError(f"{bag.path}: {topic}: {told}; times must increase")
        last_ns = own_ns
        load = _Message(bag, topic, recorded_ns, own_ns)
        shots.append(Shot(own_ns, f"{topic} at {own_ns} ns", load))
    if not shots:
        raise InputError(f"{bag.path}: topic {topic} holds no message")
    return shots


def _poses(bag: Bag, topic: str) -> TimedPoses:
    try:
        found = {stamp_ns(message): pose_of_message(message) for _, message in bag.messages(topic)}
    except InputError as error:
        raise InputError(f"{bag.path}: {topic}: {error}") from error
    if not found:
        raise InputError(f"{bag.path}: topic {topic} holds no message")
    times = sorted(found)
    try:
        return TimedPoses(np.array(times, dtype=np.int64), np.stack([found[t] for t in times]))
    except ValueError as error:
        raise InputError(f"{bag.path}: {topic}: {error}") from error


def _mount(
    bag: Bag, settings: RosbagSettings, pair: StereoCalibration
) -> tuple[Float, ImuData | None]:
    """T_robot_left (4, 4), x ahead, y left, z up, and what `imu` felt in the robot's axes."""
    transforms: list[Any] = []
    if "/tf_static" in bag.topics:
        transforms = [t for _, m in bag.messages("/tf_static") for t in m.transforms]
    camera = bag.first(settings.left).header.frame_id
    optical = se3.pose(R_ROBOT_OPTICAL, np.zeros(3))
    T_base_left = lookup_transform(transforms, settings.base, camera)
    baseline_m = float(np.linalg.norm(pair.T_left_right[:3, 3]))
    T_robot_left = (
        level_mount(baseline_m, 0.0, _HEIGHT_M)
        if T_base_left is None
        else T_base_left @ se3.inverse(optical)
    )
    if not settings.imu:
        return T_robot_left, None
    imu = bag.first(settings.imu).header.frame_id
    T_left_imu = lookup_transform(transforms, camera, imu)
    if T_left_imu is None:
        lost = f"/tf_static leads from {imu!r} to no camera {camera!r}"
        raise InputError(f"{bag.path}: --imu {settings.imu}: {lost}")
    T_camera_imu = (optical @ T_left_imu)[:3, :3]
    felt = {stamp_ns(m): m for _, m in bag.messages(settings.imu)}
    time_ns = np.array(sorted(felt), dtype=np.int64)
    messages = [felt[t] for t in time_ns.tolist()]
    forces, rates = (
        np.array([[each.x, each.y, each.z] for each in own]).reshape(-1, 3) @ T_camera_imu.T
        for own in (
            [m.linear_acceleration for m in messages],
            [m.angular_velocity for m in messages],
        )
    )
    # a covariance that begins with -1 says that nothing was measured (sensor_msgs/Imu)
    counts = all(m.angular_velocity_covariance[0] != -1 for m in messages)
    try:
        ImuData(time_ns, forces)  # is there gravity at all?
        T_robot_left = upright(T_robot_left, forces.mean(axis=0))
        turn = T_robot_left[:3, :3].T
        return T_robot_left, ImuData(time_ns, forces @ turn, rates @ turn if counts else None)
    except InputError as error:
        raise InputError(f"{bag.path}: --imu {settings.imu}: {error}") from error
