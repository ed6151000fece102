"""Stereo recordings in ROS 1 and ROS 2 bags: importer and exporter.

A bag to import holds two topics of pictures (Image or CompressedImage) with a CameraInfo each, by
default in the namespace of the pictures. Odometry (Odometry), an IMU (Imu) and true poses
(Odometry, PoseStamped and others) are optional. The mount of the left camera is read from the
static transforms of `/tf_static` if they connect the frames of camera and robot. Measured gravity
replaces the roll and pitch of these transforms.

Exported topics: `/left/image_rect`, `/right/image_rect` (Image, mono8), `/left/camera_info`,
`/right/camera_info`, `/odom` (Odometry in the frame `odom`), `/truth` (PoseStamped in the frame
`world`), `/tf_static` (the cameras on `base_link`).
"""

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np

from mapfusion.datasets.camera_calibration import (
    R_ROBOT_OPTICAL,
    Distortion,
    Lens,
    StereoCalibration,
    read_stereo_calibration,
)
from mapfusion.datasets.imu import ImuData
from mapfusion.datasets.levelling import MountSettings, level_mount, upright
from mapfusion.datasets.stereo_recording import (
    OnFrame,
    ReadYaml,
    Shot,
    StereoDrive,
    StereoRecording,
    pair_shots,
)
from mapfusion.datasets.text_files import NS, TimedPoses
from mapfusion.errors import InputError, did_you_mean, one_line
from mapfusion.files import PART, temporary_prefix, write_atomically
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


_SHOWN_TOPICS = 12  # of a bag, in a message
_IMAGE_TYPES = ("Image", "CompressedImage")
_POSE_TYPES = ("Odometry", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")
_HEIGHT_M = 0.5  # of a camera without a stated mount; an error shifts all heights equally


class Bag:
    """Open bag; damaged contents raise an InputError that names the bag."""

    def __init__(self, path: Path) -> None:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        if not path.exists():
            raise InputError(f"{path}: no such file or folder (a ROS bag)")
        self.path = path
        try:
            # For bags of ROS 2 without definitions of the message types.
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
        except Exception as error:  # readers of several formats raise exceptions of many types
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> InputError:
        reason = one_line(str(error)) or type(error).__name__
        return InputError(f"{self.path}: damaged or no ROS bag ({reason})")

    @property
    def topics(self) -> dict[str, str]:
        """Type of each topic's messages."""
        return {each.topic: each.msgtype for each in self._reader.connections}

    def require(self, option: str, topic: str, *types: str) -> str:
        """Return the message type of a topic.

        Raises:
            InputError: the topic does not exist, or its type is none of `types`; the message names
                the option.
        """
        type_by_topic = self.topics
        if topic not in type_by_topic:
            named = ", ".join(sorted(type_by_topic)[:_SHOWN_TOPICS]) or "none"
            suggestion = did_you_mean(topic, type_by_topic)
            raise InputError(
                f"{self.path}: {option} {topic}: no such topic{suggestion}; there: {named}"
            )
        if type_by_topic[topic].rsplit("/", 1)[-1] not in types:
            expected = " or ".join(types)
            problem = f"holds {type_by_topic[topic]}, expected {expected}"
            raise InputError(f"{self.path}: {option} {topic}: {problem}")
        return type_by_topic[topic]

    def messages(self, topic: str, at_ns: int | None = None) -> Iterator[tuple[int, Any]]:
        """Yield recording time (ns) and message of a topic, only those of time `at_ns` if given."""
        connections: list[Connection] = [
            each for each in self._reader.connections if each.topic == topic
        ]
        stop = None if at_ns is None else at_ns + 1
        try:
            for connection, time_ns, data in self._reader.messages(connections, at_ns, stop):
                yield time_ns, self._reader.deserialize(data, connection.msgtype)
        except InputError:
            raise
        except Exception as error:
            raise self._damaged(error) from error

    def first(self, topic: str) -> Any:
        """Return the first message of a topic; raise InputError if there is none."""
        for _, message in self.messages(topic):
            return message
        raise InputError(f"{self.path}: topic {topic} holds no message")


def stamp_ns(message: Any) -> int:
    """Return the time stamp of a message in ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS + int(stamp.nanosec)


# Encoding: type of a channel, number of channels, OpenCV conversion to grey.
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
    "bayer_rggb16": (np.uint16, 1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr16": (np.uint16, 1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg16": (np.uint16, 1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg16": (np.uint16, 1, cv2.COLOR_BayerGB2GRAY),
    "yuv422": (np.uint8, 2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (np.uint8, 2, cv2.COLOR_YUV2GRAY_YUY2),
}
_MOSAIC = "bayer_"  # beginning of the encodings with one colour a pixel
_DISTORTIONS: dict[str, Distortion] = {
    "plumb_bob": "radial-tangential",
    "rational_polynomial": "radial-tangential",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "": "none",
    "none": "none",
}


def decode_image(message: Any) -> np.ndarray:
    """Return the grey levels of an Image or a CompressedImage, shape (H, W), uint8 or uint16.

    Raises:
        InputError: the encoding is not supported, or bytes are missing.
    """
    if not hasattr(message, "encoding"):
        # The format begins with the encoding before compression: "bayer_rggb8; jpeg compressed".
        stated = str(message.format).partition(";")[0].strip()
        is_mosaic = stated.startswith(_MOSAIC)
        if is_mosaic and stated not in _ENCODINGS:
            raise _unknown_encoding(stated)
        flags = cv2.IMREAD_UNCHANGED if is_mosaic else cv2.IMREAD_ANYDEPTH
        image = cv2.imdecode(np.asarray(message.data, np.uint8), flags)
        if image is None:
            raise InputError(f"compressed picture of format {message.format!r}: cannot be decoded")
        if image.ndim > 2:  # the colours were interpolated before compression
            return cv2.cvtColor(image[:, :, :3], cv2.COLOR_BGR2GRAY)
        conversion = _ENCODINGS[stated][2] if is_mosaic else None
        return image if conversion is None else cv2.cvtColor(image, conversion)
    if message.encoding not in _ENCODINGS:
        raise _unknown_encoding(message.encoding)
    kind, channels, conversion = _ENCODINGS[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * np.dtype(kind).itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if not 0 < row_bytes <= step or len(data) < height * step:
        raise InputError(f"picture of {width}x{height}: has {len(data)} bytes, rows of {step}")
    order = ">" if message.is_bigendian else "<"
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row_bytes])
    levels = rows.view(np.dtype(kind).newbyteorder(order)).astype(kind)
    levels = levels.reshape((height, width, channels) if channels > 1 else (height, width))
    return levels if conversion is None else cv2.cvtColor(levels, conversion)


def _unknown_encoding(encoding: str) -> InputError:
    return InputError(f"encoding {encoding!r}: is not read; known: {', '.join(_ENCODINGS)}")


def stereo_calibration(left: Any, right: Any, rectified: bool) -> StereoCalibration:
    """Return the calibration of two CameraInfo messages, for raw or for rectified pictures.

    Raises:
        InputError: the messages describe no stereo pair, or a lens model is not supported.
    """
    P_right = _matrix(right, "P", (3, 4))
    if not P_right[0, 0] > 0:
        raise InputError("camera_info: the right camera's P holds no focal length")
    baseline_m = -P_right[0, 3] / P_right[0, 0]
    if not baseline_m > 0:
        problem = "the right camera's P holds no baseline"
        raise InputError(f"camera_info: {problem}; are the cameras a pair, and not exchanged?")
    apart = se3.pose(np.eye(3), [baseline_m, 0.0, 0.0])
    if rectified:
        return StereoCalibration(_rectified_lens(left), _rectified_lens(right), apart)
    turned = [se3.pose(_matrix(info, "R", (3, 3)), np.zeros(3)) for info in (left, right)]
    T_left_right = se3.inverse(turned[0]) @ apart @ turned[1]
    lenses = []
    for side, info in (("left", left), ("right", right)):
        try:
            K, model = _matrix(info, "K", (3, 3)), str(info.distortion_model)
            if model not in _DISTORTIONS:
                known_names = ", ".join(name for name in _DISTORTIONS if name)
                raise InputError(f"distortion_model {model!r} is unknown; known: {known_names}")
            coefficients = _matrix(info, "D", (-1,))
            if model == "rational_polynomial" and not coefficients[5:].any():
                coefficients = coefficients[:5]
            distortion = _DISTORTIONS[model] if coefficients.any() else "none"
            coefficient_tuple = tuple(coefficients.tolist()) if distortion != "none" else ()
            size = (int(info.width), int(info.height))
            lenses.append(
                Lens(size, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), distortion, coefficient_tuple)
            )
        except InputError as error:
            raise InputError(f"camera_info of the {side} camera: {error}") from error
    return StereoCalibration(lenses[0], lenses[1], T_left_right)


def pose_of_message(message: Any) -> Float:
    """Return the pose (4, 4) of a message of one of the types `_POSE_TYPES`."""
    if hasattr(message, "transform"):
        t, q = message.transform.translation, message.transform.rotation
    else:
        pose_message = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        t, q = pose_message.position, pose_message.orientation
    xyzw = np.array([q.x, q.y, q.z, q.w])
    if not np.linalg.norm(xyzw) > 0:
        raise InputError("a pose has a quaternion of length 0")
    return se3.from_quaternions([t.x, t.y, t.z], xyzw)


def lookup_transform(transforms: list[Any], target: str, source: str) -> Float | None:
    """Return T_target_source (4, 4) from a tree of TransformStamped; None if unconnected."""
    parent = {
        _frame(t.child_frame_id): (_frame(t.header.frame_id), pose_of_message(t))
        for t in transforms
    }
    # T_ancestor_frame of all ancestors of target and source, the nearest ancestor first.
    ancestors = []
    for name in (target, source):
        frame, T = _frame(name), np.eye(4)
        T_by_frame = {frame: T}
        while frame in parent and parent[frame][0] not in T_by_frame:
            frame, T_parent_frame = parent[frame]
            T = T_parent_frame @ T
            T_by_frame[frame] = T
        ancestors.append(T_by_frame)
    for frame, T_frame_source in ancestors[1].items():
        if frame in ancestors[0]:
            return se3.inverse(ancestors[0][frame]) @ T_frame_source
    return None


def _frame(name: str) -> str:
    """Return the name of a frame without the slash of ROS 1."""
    return name.removeprefix("/")


def _matrix(info: Any, name: str, shape: tuple[int, ...]) -> Float:
    """Return K, D, R or P of a CameraInfo; ROS 2 writes these names in lower case."""
    values = getattr(info, name, None)
    values = getattr(info, name.lower()) if values is None else values
    return np.asarray(values, np.float64).reshape(shape)


def _rectified_lens(info: Any) -> Lens:
    """Return the camera of rectified pictures."""
    P = _matrix(info, "P", (3, 4))
    size = (int(info.width), int(info.height))
    return Lens(size, (P[0, 0], P[1, 1]), (P[0, 2], P[1, 2]))


@dataclass(frozen=True)
class RosbagSettings:
    """Topics of a bag.

    Attributes:
        left: pictures of the left camera.
        right: pictures of the right camera.
        odom: dead reckoning of the robot; if empty, visual odometry is used.
        imu: accelerations, which level each frame and whose mean over the recording points up; if
            empty, the mount of the static transforms is used.
        truth: true poses of the robot; if empty, they are unknown.
        left_info: calibration of the left camera; by default `camera_info` beside its pictures, or
            one level up for compressed pictures.
        right_info: calibration of the right camera.
        calibration: calibration file in the layout of Kalibr or OpenCV in place of the messages.
        repeated: `first` keeps the first of several pictures with the same time; `refuse` raises
            an error.
        rectified: True if the pictures are rectified; by default if the names of both topics
            contain `rect`.
        base: robot frame (x ahead, z up) in `/tf_static`.
        mount: replaces the recorded mount.
    """

    left: str = "/left/image_raw"
    right: str = "/right/image_raw"
    odom: str = ""
    imu: str = ""
    truth: str = ""
    left_info: str = ""
    right_info: str = ""
    calibration: str = ""
    repeated: Literal["refuse", "first"] = "refuse"
    rectified: bool | None = None
    base: str = "base_link"
    mount: MountSettings = field(default_factory=MountSettings)


@dataclass(frozen=True)
class _BagPicture:
    """Picture in a bag, which is read when it is called."""

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


def read_rosbag(path: Path, settings: RosbagSettings, read_yaml: ReadYaml) -> StereoRecording:
    """Read a bag; pictures are loaded later.

    Raises:
        InputError: the bag is damaged or lacks a topic; the message names bag and topic.
    """
    bag = Bag(path)
    topics = (settings.left, settings.right)
    for option, topic in zip(("--left", "--right"), topics, strict=True):
        bag.require(option, topic, *_IMAGE_TYPES)
    for option, topic in (("--odom", settings.odom), ("truth", settings.truth)):
        if topic:
            bag.require(option, topic, *_POSE_TYPES)
    if settings.imu:
        bag.require("--imu", settings.imu, "Imu")

    # Calibration of the pair.
    calibrated_by = f"{path}: camera_info of {settings.left} and {settings.right}"
    if settings.calibration:
        calibrated_by = settings.calibration
        file = Path(settings.calibration)
        size_px = decode_image(bag.first(settings.left)).shape[1::-1]
        pair, _ = read_stereo_calibration(file, read_yaml(file), size_px)
    else:
        infos = [
            bag.first(_info_topic(bag, option, topic, own))
            for option, topic, own in (
                ("left_info", settings.left, settings.left_info),
                ("right_info", settings.right, settings.right_info),
            )
        ]
        rectified = settings.rectified
        if rectified is None:
            rectified = all("rect" in topic for topic in topics)
        try:
            pair = stereo_calibration(infos[0], infos[1], rectified)
        except (InputError, ValueError) as error:
            raise InputError(f"{path}: {error}") from error

    (left, twice_left), (right, twice_right) = (
        _read_pictures(bag, topic, settings.repeated) for topic in topics
    )
    time_ns, pictures, dropped = pair_shots(path, left, right)
    dropped = (*twice_left, *twice_right, *dropped)
    T_robot_left, inertial = _read_mount(bag, settings, pair)
    T_robot_left = settings.mount.applied(T_robot_left)
    odometry, truth = (
        _read_poses(bag, topic) if topic else None for topic in (settings.odom, settings.truth)
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
        inertial,
        calibrated_by,
    )


def _info_topic(bag: Bag, option: str, topic: str, own: str) -> str:
    """Return the topic of a camera's CameraInfo.

    The topic `own` if it is given, else `camera_info` beside the pictures. Compressed pictures are
    a level below (`image/compressed`), so the level above is tried, too.
    """
    spaces = [topic.rsplit("/", n)[0] for n in (1, 2)]
    tried = [f"{space}/camera_info" for space in spaces]
    if not bag.topics[topic].endswith("/CompressedImage"):
        tried = tried[:1]
    present = [each for each in tried if each in bag.topics]
    if not own and not present:
        others = [name for name, kind in bag.topics.items() if kind.endswith("/CameraInfo")]
        topics_text = f"topics of this type: {', '.join(sorted(others)) or 'none'}"
        remedy = f"give one by --param {option}=TOPIC, or a file by --calibration FILE"
        lacking = f"no such topic {tried[0]} (CameraInfo of {topic})"
        raise InputError(f"{bag.path}: {lacking}; {topics_text}; {remedy}")
    chosen = own or present[0]
    bag.require(option, chosen, "CameraInfo")
    return chosen


def _read_pictures(
    bag: Bag, topic: str, repeated: Literal["refuse", "first"]
) -> tuple[list[Shot], list[str]]:
    """Return the pictures of a topic, and a line about those that repeat a time.

    Times must increase.
    """
    shots, last_ns, n_repeated = list[Shot](), None, 0
    for recorded_ns, message in bag.messages(topic):
        own_ns = stamp_ns(message)
        if own_ns == last_ns and repeated == "first":
            n_repeated += 1
            continue
        if last_ns is not None and own_ns <= last_ns:
            order_problem = f"runs back by {(last_ns - own_ns) / 1e9:g} s; times must increase"
            if own_ns == last_ns:
                order_problem = (
                    "repeats the time before; --repeated first keeps the first of each time"
                )
            problem = f"the picture recorded at {recorded_ns} ns {order_problem}"
            raise InputError(f"{bag.path}: {topic}: {problem}")
        last_ns = own_ns
        load = _BagPicture(bag, topic, recorded_ns, own_ns)
        shots.append(Shot(own_ns, f"{topic} at {own_ns} ns", load))
    if not shots:
        raise InputError(f"{bag.path}: topic {topic} holds no message")
    twice = f"{n_repeated} pictures of {topic} that repeat the time of the picture before"
    return shots, [twice] if n_repeated else []


def _read_poses(bag: Bag, topic: str) -> TimedPoses:
    """Return the poses of a topic in the order of time."""
    try:
        pose_by_stamp = {
            stamp_ns(message): pose_of_message(message) for _, message in bag.messages(topic)
        }
    except InputError as error:
        raise InputError(f"{bag.path}: {topic}: {error}") from error
    if not pose_by_stamp:
        raise InputError(f"{bag.path}: topic {topic} holds no message")
    times = sorted(pose_by_stamp)
    try:
        return TimedPoses(
            np.array(times, dtype=np.int64), np.stack([pose_by_stamp[t] for t in times])
        )
    except ValueError as error:
        raise InputError(f"{bag.path}: {topic}: {error}") from error


def _read_mount(
    bag: Bag, settings: RosbagSettings, pair: StereoCalibration
) -> tuple[Float, ImuData | None]:
    """Return T_robot_left (4, 4), x ahead, y left, z up, and the IMU data in the robot's axes."""
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
        message = f"/tf_static leads from {imu!r} to no camera {camera!r}"
        raise InputError(f"{bag.path}: --imu {settings.imu}: {message}")
    T_camera_imu = (optical @ T_left_imu)[:3, :3]
    measured = {stamp_ns(m): m for _, m in bag.messages(settings.imu)}
    time_ns = np.array(sorted(measured), dtype=np.int64)
    messages = [measured[t] for t in time_ns.tolist()]
    forces, rates = (
        np.array([[each.x, each.y, each.z] for each in own]).reshape(-1, 3) @ T_camera_imu.T
        for own in (
            [m.linear_acceleration for m in messages],
            [m.angular_velocity for m in messages],
        )
    )
    # A covariance that begins with -1 marks missing angular velocities (sensor_msgs/Imu).
    has_rates = all(m.angular_velocity_covariance[0] != -1 for m in messages)
    try:
        ImuData(time_ns, forces)  # checks that gravity is present
        T_robot_left = upright(T_robot_left, forces.mean(axis=0))
        turn = T_robot_left[:3, :3].T
        return T_robot_left, ImuData(time_ns, forces @ turn, rates @ turn if has_rates else None)
    except InputError as error:
        raise InputError(f"{bag.path}: --imu {settings.imu}: {error}") from error


_SIDES = ("left", "right")
_BASE = "base_link"
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"  # definition of tf2_msgs/TFMessage
_TYPES = {
    "image_rect": "sensor_msgs/msg/Image",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "odom": "nav_msgs/msg/Odometry",
    "truth": "geometry_msgs/msg/PoseStamped",
    "tf_static": "tf2_msgs/msg/TFMessage",
}
_METADATA = "metadata.yaml"  # file that identifies a folder as a bag of ROS 2
_BAG_VERSION = 8  # of the layout, supported by ROS 2 Humble and later
_QUEUE = 10  # length of the queue of a subscriber, the default of ROS 2
_FIRST_NS = NS  # added to all times, because 0 means no time in ROS


def write_rosbag(folder: Path, drive: StereoDrive, on_frame: OnFrame) -> list[Path]:
    """Write a drive to the bag `folder/ROBOT.bag` and return its path."""
    path = folder / f"{drive.robot}.bag"

    def fill(temporary: Path) -> None:
        from rosbags.rosbag1 import Writer

        temporary.unlink()  # the writer creates the file
        with Writer(temporary) as bag:
            _Messages(drive, _Ros1()).put_all(bag, on_frame)

    write_atomically(path, fill)
    return [path]


def write_rosbag2(folder: Path, drive: StereoDrive, on_frame: OnFrame) -> list[Path]:
    """Write a drive to the bag `folder/ROBOT.ros2` and return its path.

    Raises:
        InputError: a folder of this name exists and is no bag.
    """
    from rosbags.rosbag2 import Writer

    path = folder / f"{drive.robot}.ros2"
    if path.exists() and not (path / _METADATA).is_file():
        raise InputError(f"{path}: is there, and no bag of ROS 2; it is left as it is")
    folder.mkdir(parents=True, exist_ok=True)
    # Files of a bag are named after its folder: write a folder of this name in a temporary one.
    around = Path(tempfile.mkdtemp(PART, temporary_prefix(path.name), folder))
    try:
        with Writer(around / path.name, version=_BAG_VERSION) as bag:
            _Messages(drive, _Ros2()).put_all(bag, on_frame)
        shutil.rmtree(path, ignore_errors=True)
        (around / path.name).replace(path)
    finally:
        shutil.rmtree(around, ignore_errors=True)
    return [path]


class _Ros1:
    """Serialisation of ROS 1."""

    header_begins = (0,)  # sequence number of the message, which is not used

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.store = get_typestore(Stores.ROS1_NOETIC)
        self.store.register(get_types_from_msg(_TRANSFORMS, _TYPES["tf_static"]))
        self.serialized = self.store.serialize_ros1

    def connection(self, bag: Any, topic: str, kind: str, keeps: bool) -> Any:
        """Add a topic to an open bag; `keeps` sends the last message to late subscribers."""
        latching = 1 if keeps else None
        return bag.add_connection(topic, kind, typestore=self.store, latching=latching)


class _Ros2:
    """Serialisation of ROS 2."""

    header_begins = ()

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        if _TYPES["tf_static"] not in self.store.types:
            self.store.register(get_types_from_msg(_TRANSFORMS, _TYPES["tf_static"]))
        self.serialized = self.store.serialize_cdr

    def connection(self, bag: Any, topic: str, kind: str, keeps: bool) -> Any:
        """Add a topic to an open bag; see `_Ros1.connection`."""
        from rosbags.interfaces import (
            Qos,
            QosDurability,
            QosHistory,
            QosLiveliness,
            QosReliability,
            QosTime,
        )

        whenever = QosTime(0, 0)
        durability = QosDurability.TRANSIENT_LOCAL if keeps else QosDurability.VOLATILE
        own = Qos(
            QosHistory.KEEP_LAST, _QUEUE, QosReliability.RELIABLE, durability, whenever, whenever,
            QosLiveliness.SYSTEM_DEFAULT, whenever, False,
        )  # fmt: skip
        return bag.add_connection(topic, kind, typestore=self.store, offered_qos_profiles=[own])


class _Messages:
    """Messages of a drive."""

    def __init__(self, drive: StereoDrive, ros: _Ros1 | _Ros2) -> None:
        self._drive, self._ros, self._store = drive, ros, ros.store

    def put_all(self, bag: Any, on_frame: OnFrame) -> None:
        """Write all messages into an open bag in the order of time."""
        drive = self._drive
        topics = [f"/{side}/{kind}" for side in _SIDES for kind in ("image_rect", "camera_info")]
        topics += ["/odom", "/truth", "/tf_static"]
        connections = {}
        for topic in topics:
            kind = _TYPES[topic.rsplit("/", 1)[-1]]
            connections[topic] = self._ros.connection(bag, topic, kind, topic == "/tf_static")

        def put(topic: str, time_ns: int, message: Any) -> None:
            data = self._ros.serialized(message, connections[topic].msgtype)
            bag.write(connections[topic], time_ns, data)

        times = (drive.time_ns + _FIRST_NS).tolist()
        # mounts of the cameras
        found = []
        for number, eye in enumerate(_SIDES):
            T = self._drive.mount(number)
            q = se3.quaternions(T[None])[0].tolist()
            moved = self._new(
                "geometry_msgs/Transform",
                self._new("geometry_msgs/Vector3", *T[:3, 3].tolist()),
                self._new("geometry_msgs/Quaternion", *q),
            )
            of_mount = self._header(times[0], _BASE)
            found.append(
                self._new("geometry_msgs/TransformStamped", of_mount, f"{eye}_optical", moved)
            )
        put("/tf_static", times[0], self._new("tf2_msgs/TFMessage", found))
        still = self._new("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        twist = self._new("geometry_msgs/Twist", still, still)
        twist = self._new("geometry_msgs/TwistWithCovariance", twist, np.zeros(36))
        reckoned, true = drive.reckoned_bodies, drive.true_bodies
        reckoned = reckoned if reckoned.ndim == 3 else se3.from_planar(reckoned)
        for k, time_ns in enumerate(times):
            for camera, image in enumerate(drive.pair(k)):
                side = _SIDES[camera]
                height, width = image.shape
                header = self._header(time_ns, f"{side}_optical")
                data = np.ascontiguousarray(image).ravel()
                picture = self._new(
                    "sensor_msgs/Image", header, height, width, "mono8", 0, width, data
                )
                put(f"/{side}/image_rect", time_ns, picture)
                put(f"/{side}/camera_info", time_ns, self._camera_info(time_ns, camera))
            # Velocities are zero, covariances unknown.
            pose = self._new(
                "geometry_msgs/PoseWithCovariance", self._pose(reckoned[k]), np.zeros(36)
            )
            header = self._header(time_ns, "odom")
            put("/odom", time_ns, self._new("nav_msgs/Odometry", header, _BASE, pose, twist))
            header = self._header(time_ns, "world")
            pose = self._new("geometry_msgs/PoseStamped", header, self._pose(true[k]))
            put("/truth", time_ns, pose)
            on_frame(k + 1, len(drive))

    def _new(self, name: str, *values: Any) -> Any:
        """Return a new message of a type."""
        return self._store.types[name.replace("/", "/msg/")](*values)

    def _header(self, time_ns: int, frame: str) -> Any:
        """Return a header with time stamp and frame."""
        stamp = self._new("builtin_interfaces/Time", *divmod(time_ns, NS))
        return self._new("std_msgs/Header", *self._ros.header_begins, stamp, frame)

    def _camera_info(self, time_ns: int, camera: int) -> Any:
        """Return the CameraInfo of the left (0) or the right camera (1)."""
        pair, (cu, cv) = self._drive.camera, self._drive.camera.center_px
        f = pair.focal_px
        K = np.array([f, 0, cu, 0, f, cv, 0, 0, 1])
        P = np.array([f, 0, cu, -camera * f * pair.baseline_m, 0, f, cv, 0, 0, 0, 1, 0])
        header = self._header(time_ns, f"{_SIDES[camera]}_optical")
        region = self._new("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        return self._new(
            "sensor_msgs/CameraInfo", header, pair.height_px, pair.width_px, "plumb_bob",
            np.zeros(5), K, np.eye(3).ravel(), P, 0, 0, region,
        )  # fmt: skip

    def _pose(self, T: Float) -> Any:
        """Return a Pose message."""
        q = se3.quaternions(T[None])[0].tolist()
        point = self._new("geometry_msgs/Point", *T[:3, 3].tolist())
        return self._new("geometry_msgs/Pose", point, self._new("geometry_msgs/Quaternion", *q))
