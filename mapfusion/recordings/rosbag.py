"""Stereo recordings in ROS bags: ROS 1 (`.bag`) and ROS 2 (a folder with `metadata.yaml`).

Two topics of pictures (Image or CompressedImage) with a CameraInfo each, in the namespace of the
pictures as usual; optionally odometry (Odometry), an IMU (Imu) and true poses (Odometry,
PoseStamped and others). The static transforms of `/tf_static` tell how the left camera is mounted,
where they connect its frame to the robot's; measured gravity takes the place of their roll and
pitch.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion import se3
from mapfusion.errors import InputError
from mapfusion.recordings.bag import Bag, stamp_ns
from mapfusion.recordings.inertial import Inertial
from mapfusion.recordings.lens import R_ROBOT_OPTICAL, StereoCalibration
from mapfusion.recordings.mount import MountSettings, level_mount, upright
from mapfusion.recordings.ros_messages import calibration, chained, picture, pose
from mapfusion.recordings.stereo_recording import ReadYaml, Shot, StereoRecording, paired
from mapfusion.recordings.timed_poses import TimedPoses
from mapfusion.se2 import Float

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
                    return picture(message)
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
        time_ns, pictures, dropped = paired(left, right)
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
        return calibration(infos[0], infos[1], rectified)
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
        found = {stamp_ns(message): pose(message) for _, message in bag.messages(topic)}
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
) -> tuple[Float, Inertial | None]:
    """T_robot_left (4, 4), x ahead, y left, z up, and what `imu` felt in the robot's axes."""
    transforms: list[Any] = []
    if "/tf_static" in bag.topics:
        transforms = [t for _, m in bag.messages("/tf_static") for t in m.transforms]
    camera = bag.first(settings.left).header.frame_id
    optical = se3.pose(R_ROBOT_OPTICAL, np.zeros(3))
    T_base_left = chained(transforms, settings.base, camera)
    baseline_m = float(np.linalg.norm(pair.T_left_right[:3, 3]))
    T_robot_left = (
        level_mount(baseline_m, 0.0, _HEIGHT_M)
        if T_base_left is None
        else T_base_left @ se3.inverse(optical)
    )
    if not settings.imu:
        return T_robot_left, None
    imu = bag.first(settings.imu).header.frame_id
    T_left_imu = chained(transforms, camera, imu)
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
        Inertial(time_ns, forces)  # is there gravity at all?
        T_robot_left = upright(T_robot_left, forces.mean(axis=0))
        turn = T_robot_left[:3, :3].T
        return T_robot_left, Inertial(time_ns, forces @ turn, rates @ turn if counts else None)
    except InputError as error:
        raise InputError(f"{bag.path}: --imu {settings.imu}: {error}") from error
