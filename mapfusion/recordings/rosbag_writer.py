"""A drive as a bag of ROS 1 (`rosbags-convert` makes one of ROS 2 of it).

Topics: `/left/image_rect`, `/right/image_rect` (Image, mono8), `/left/camera_info`,
`/right/camera_info`, `/odom` (Odometry in the frame `odom`), `/truth` (PoseStamped in the frame
`world`), `/tf_static` (the cameras on `base_link`).
"""

from pathlib import Path
from typing import Any

import numpy as np

from mapfusion import se3
from mapfusion.recordings.stereo_drive import OnFrame, StereoDrive
from mapfusion.recordings.text_tables import NS
from mapfusion.se2 import Float
from mapfusion.storage import write_whole

_SIDES = ("left", "right")
_BASE = "base_link"
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"  # tf2_msgs/TFMessage, whole
_TYPES = {
    "image_rect": "sensor_msgs/msg/Image",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "odom": "nav_msgs/msg/Odometry",
    "truth": "geometry_msgs/msg/PoseStamped",
    "tf_static": "tf2_msgs/msg/TFMessage",
}
_FIRST_NS = NS  # added to times: a time of 0 is none in ROS


def write_rosbag(folder: Path, drive: StereoDrive, on_frame: OnFrame) -> list[Path]:
    """Write a drive to `folder/ROBOT.bag`; returns that."""
    path = folder / f"{drive.robot}.bag"

    def fill(temporary: Path) -> None:
        from rosbags.rosbag1 import Writer

        temporary.unlink()  # the writer wants to make it
        with Writer(temporary) as bag:
            _Messages(drive).put_all(bag, on_frame)

    write_whole(path, fill)
    return [path]


class _Messages:
    """The messages of a drive."""

    def __init__(self, drive: StereoDrive) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._drive = drive
        self._store = get_typestore(Stores.ROS1_NOETIC)
        self._store.register(get_types_from_msg(_TRANSFORMS, _TYPES["tf_static"]))

    def put_all(self, bag: Any, on_frame: OnFrame) -> None:
        """Write all into an open bag, in the order of time."""
        drive = self._drive
        topics = [f"/{side}/{kind}" for side in _SIDES for kind in ("image_rect", "camera_info")]
        topics += ["/odom", "/truth", "/tf_static"]
        connections = {}
        for topic in topics:
            kind = _TYPES[topic.rsplit("/", 1)[-1]]
            latching = 1 if topic == "/tf_static" else None
            connections[topic] = bag.add_connection(
                topic, kind, typestore=self._store, latching=latching
            )

        def put(topic: str, time_ns: int, message: Any) -> None:
            data = self._store.serialize_ros1(message, connections[topic].msgtype)
            bag.write(connections[topic], time_ns, data)

        times = (drive.time_ns + _FIRST_NS).tolist()
        put("/tf_static", times[0], self._mounts(times[0]))
        reckoned, true = drive.reckoned_bodies, drive.true_bodies
        reckoned = reckoned if reckoned.ndim == 3 else se3.from_planar(reckoned)
        for k, time_ns in enumerate(times):
            for camera, image in enumerate(drive.pair(k)):
                side = _SIDES[camera]
                put(f"/{side}/image_rect", time_ns, self._image(time_ns, side, image))
                put(f"/{side}/camera_info", time_ns, self._info(time_ns, camera))
            put("/odom", time_ns, self._odometry(time_ns, reckoned[k]))
            put("/truth", time_ns, self._stamped(time_ns, true[k]))
            on_frame(k + 1, len(drive))

    def _new(self, name: str, *values: Any) -> Any:
        return self._store.types[name.replace("/", "/msg/")](*values)

    def _header(self, time_ns: int, frame: str) -> Any:
        stamp = self._new("builtin_interfaces/Time", *divmod(time_ns, NS))
        return self._new("std_msgs/Header", 0, stamp, frame)

    def _image(self, time_ns: int, side: str, image: np.ndarray) -> Any:
        height, width = image.shape
        header = self._header(time_ns, f"{side}_optical")
        data = np.ascontiguousarray(image).ravel()
        return self._new("sensor_msgs/Image", header, height, width, "mono8", 0, width, data)

    def _info(self, time_ns: int, camera: int) -> Any:
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
        q = se3.quaternions(T[None])[0].tolist()
        point = self._new("geometry_msgs/Point", *T[:3, 3].tolist())
        return self._new("geometry_msgs/Pose", point, self._new("geometry_msgs/Quaternion", *q))

    def _stamped(self, time_ns: int, pose: Float) -> Any:
        header = self._header(time_ns, "world")
        return self._new("geometry_msgs/PoseStamped", header, self._pose(pose))

    def _odometry(self, time_ns: int, pose: Float) -> Any:
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

    def _mounts(self, time_ns: int) -> Any:
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
