"""Exporter of stereo drives as bags of ROS 1 and ROS 2.

Topics: `/left/image_rect`, `/right/image_rect` (Image, mono8), `/left/camera_info`,
`/right/camera_info`, `/odom` (Odometry in the frame `odom`), `/truth` (PoseStamped in the frame
`world`), `/tf_static` (the cameras on `base_link`).
"""

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.datasets.export import OnFrame, StereoDrive
from mapfusion.datasets.text_files import NS
from mapfusion.errors import InputError
from mapfusion.files import PART, temporary_prefix, write_whole
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float

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

    write_whole(path, fill)
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
        put("/tf_static", times[0], self._static_transforms(times[0]))
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
            put("/odom", time_ns, self._odometry(time_ns, reckoned[k]))
            header = self._header(time_ns, "world")
            put(
                "/truth",
                time_ns,
                self._new("geometry_msgs/PoseStamped", header, self._pose(true[k])),
            )
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

    def _odometry(self, time_ns: int, pose: Float) -> Any:
        """Return an Odometry message with unknown covariances and zero velocities."""
        unknown, still = np.zeros(36), self._new("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        own = self._pose(pose)
        return self._new(
            "nav_msgs/Odometry",
            self._header(time_ns, "odom"),
            _BASE,
            self._new("geometry_msgs/PoseWithCovariance", own, unknown),
            self._new(
                "geometry_msgs/TwistWithCovariance",
                self._new("geometry_msgs/Twist", still, still),
                unknown,
            ),
        )

    def _static_transforms(self, time_ns: int) -> Any:
        """Return the TFMessage of the camera mounts."""
        found = []
        for camera, side in enumerate(_SIDES):
            T = self._drive.mount(camera)
            q = se3.quaternions(T[None])[0].tolist()
            moved = self._new(
                "geometry_msgs/Transform",
                self._new("geometry_msgs/Vector3", *T[:3, 3].tolist()),
                self._new("geometry_msgs/Quaternion", *q),
            )
            header = self._header(time_ns, _BASE)
            found.append(
                self._new("geometry_msgs/TransformStamped", header, f"{side}_optical", moved)
            )
        return self._new("tf2_msgs/TFMessage", found)
