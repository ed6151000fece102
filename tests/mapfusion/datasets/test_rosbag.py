"""ROS bags: handwritten ROS 2 bags, and damaged or incomplete bags of both versions."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapfusion.datasets.camera_calibration import R_ROBOT_OPTICAL
from mapfusion.datasets.formats import export_drive, read_recording
from mapfusion.datasets.rosbag import RosbagSettings, decode_image, lookup_transform
from mapfusion.datasets.stereo_recording import StereoDrive
from mapfusion.errors import InputError
from tests.mapfusion.datasets.written_layouts import (
    CAMERA,
    POSES,
    TIMES_S,
    drive,
    read_yaml,
    write_calibration,
)

STORE = get_typestore(Stores.ROS2_HUMBLE)
if "tf2_msgs/msg/TFMessage" not in STORE.types:
    STORE.register(
        get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
    )
T = STORE.types
SIDES = ("left", "right")
TILT_RAD = 0.1  # of the camera, looking down
LEFT_M = np.array([0.3, 0.045, 0.8])


def header(k: int, frame: str) -> Any:
    ns = round(1e9 * (5 + TIMES_S[k]))
    return T["std_msgs/msg/Header"](T["builtin_interfaces/msg/Time"](*divmod(ns, 10**9)), frame)


def info(k: int, camera: int) -> Any:
    f, (cu, cv) = CAMERA.focal_px, CAMERA.center_px
    P = np.array([f, 0, cu, -camera * f * CAMERA.baseline_m, 0, f, cv, 0, 0, 0, 1, 0])
    K, R = np.array([f, 0, cu, 0, f, cv, 0, 0, 1]), np.eye(3).ravel()
    own = header(k, f"{SIDES[camera]}_cam"), CAMERA.height_px, CAMERA.width_px
    region = T["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return T["sensor_msgs/msg/CameraInfo"](*own, "plumb_bob", np.zeros(5), K, R, P, 0, 0, region)


def transform(parent: str, child: str, R: np.ndarray, t: np.ndarray) -> Any:
    w = np.sqrt(max(1 + np.trace(R), 0)) / 2
    xyz = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w)
    q = T["geometry_msgs/msg/Quaternion"](*xyz.tolist(), float(w))
    own = T["geometry_msgs/msg/Vector3"](*np.asarray(t, float).tolist())
    moved = T["geometry_msgs/msg/Transform"](own, q)
    return T["geometry_msgs/msg/TransformStamped"](header(0, parent), child, moved)


def tilted() -> np.ndarray:
    cos, sin = np.cos(TILT_RAD), np.sin(TILT_RAD)
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]) @ R_ROBOT_OPTICAL


def messages(encoding: str) -> list[tuple[str, str, int, Any]]:
    """Return topic, type, frame and message of a short drive in the order of time."""
    found = []
    for k, pair in enumerate(drive()[:3]):
        for camera, image in enumerate(pair):
            topic, own = f"/{SIDES[camera]}", header(k, f"{SIDES[camera]}_cam")
            found.append((f"{topic}/camera_info", "sensor_msgs/msg/CameraInfo", k, info(k, camera)))
            data, step = image.ravel(), CAMERA.width_px
            if encoding == "rgb8":
                data, step = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB).ravel(), 3 * step
            if encoding == "compressed":
                data = cv2.imencode(".png", image)[1].ravel()
                kind = "sensor_msgs/msg/CompressedImage"
                message = T[kind](own, "png", data)
            else:
                kind = "sensor_msgs/msg/Image"
                size = CAMERA.height_px, CAMERA.width_px
                message = T[kind](own, *size, encoding, 0, step, data)
            found.append((f"{topic}/image", kind, k, message))
        up = tilted().T @ [0, 0, 9.81]
        vector, quaternion = T["geometry_msgs/msg/Vector3"], T["geometry_msgs/msg/Quaternion"]
        imu = T["sensor_msgs/msg/Imu"](
            header(k, "imu"), quaternion(0.0, 0.0, 0.0, 1.0), np.zeros(9),
            vector(0.0, 0.0, 0.0), np.zeros(9), vector(*up.tolist()), np.zeros(9),
        )  # fmt: skip
        found.append(("/imu", "sensor_msgs/msg/Imu", k, imu))
    mounts = [
        transform("base_link", "mast", np.eye(3), np.array([0.3, 0, 0])),
        transform("mast", "left_cam", tilted(), LEFT_M - [0.3, 0, 0]),
        transform("left_cam", "imu", np.eye(3), np.array([0.01, 0, 0])),
    ]
    static = T["tf2_msgs/msg/TFMessage"](mounts)
    return [("/tf_static", "tf2_msgs/msg/TFMessage", 0, static), *found]


def write(path: Path, encoding: str = "mono8", sent: list | None = None) -> Path:
    with Writer(path, version=9) as bag:
        connections: dict[str, Any] = {}
        for topic, kind, k, message in sent or messages(encoding):
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=STORE)
            data = STORE.serialize_cdr(message, kind)
            bag.write(connections[topic], round(1e9 * (5 + TIMES_S[k])), data)
    return path


def settings(**changed: Any) -> RosbagSettings:
    return RosbagSettings(**{"left": "/left/image", "right": "/right/image"} | changed)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("bags") / "drive")


@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "compressed"])
def test_pictures_of_ros_2_are_read(encoding: str, tmp_path: Path) -> None:
    recording = read_recording("rosbag", write(tmp_path / "drive", encoding), settings())
    assert recording.name == "drive"
    for k, pair in enumerate(drive()[:3]):
        for found, image in zip(recording.pair(k), pair, strict=True):
            np.testing.assert_array_equal(found, image)


def test_the_mount_follows_the_static_transforms(bag: Path) -> None:
    T_robot_left = read_recording("rosbag", bag, settings()).T_robot_left
    np.testing.assert_allclose(T_robot_left[:3, 3], LEFT_M, atol=1e-12)
    np.testing.assert_allclose(T_robot_left[:3, :3], tilted() @ R_ROBOT_OPTICAL.T, atol=1e-12)


def test_gravity_levels_a_camera_that_no_transform_mounts(bag: Path) -> None:
    own = settings(imu="/imu", base="nowhere")
    T_robot_left = read_recording("rosbag", bag, own).T_robot_left
    np.testing.assert_allclose(T_robot_left[:3, :3], tilted() @ R_ROBOT_OPTICAL.T, atol=1e-12)


def test_frames_are_chained_up_and_down_a_tree() -> None:
    rng = np.random.default_rng(0)
    turned = np.eye(3)
    a, b, c = rng.normal(size=(3, 3))
    tree = [
        transform("root", "a", turned, a),
        transform("a", "b", turned, b),
        transform("/root", "/c", turned, c),
    ]
    found = lookup_transform(tree, "c", "b")
    assert found is not None
    np.testing.assert_allclose(found[:3, 3], a + b - c, atol=1e-12)
    assert lookup_transform(tree, "c", "elsewhere") is None


def test_rows_with_padding_and_deep_levels_are_read() -> None:
    levels = np.arange(12, dtype=np.uint16).reshape(3, 4) * 300
    padded = np.zeros((3, 10), np.uint8)
    padded[:, :8] = levels.astype(">u2").view(np.uint8)
    message = T["sensor_msgs/msg/Image"](header(0, "c"), 3, 4, "mono16", 1, 10, padded.ravel())
    np.testing.assert_array_equal(decode_image(message), levels)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"left": "/left/imag"}, "--left /left/imag: no such topic; did you mean /left/image"),
        ({"right": "/imu"}, "--right /imu: holds sensor_msgs/msg/Imu, expected Image"),
        ({"odom": "/odom"}, "--odom /odom: no such topic"),
        ({"left_info": "/imu"}, "left_info /imu: holds"),
        ({"left_info": "/right/camera_info", "right_info": "/left/camera_info"}, "no baseline"),
    ],
)
def test_wrong_topics_are_one_line(changed: dict, words: str, bag: Path) -> None:
    with pytest.raises(InputError, match=words):
        read_recording("rosbag", bag, settings(**changed))


def test_damaged_bags_are_one_line(bag: Path, tmp_path: Path) -> None:
    pictures = drive()[:3]
    own = StereoDrive("R1", CAMERA, TIMES_S[:3], POSES[:3], 0 * POSES[:3], lambda k: pictures[k])
    (whole,) = export_drive("rosbag", tmp_path, own)
    data = whole.read_bytes()
    rect = settings(left="/left/image_rect", right="/right/image_rect")
    for n in (0, 20, len(data) // 2, len(data) - 9):
        whole.write_bytes(data[:n])
        with pytest.raises(InputError, match="R1"):
            read_recording("rosbag", whole, rect)
    for wrong in (tmp_path / "none.bag", tmp_path):
        with pytest.raises(InputError, match=str(wrong)):
            read_recording("rosbag", wrong, settings())


def without_info() -> list:
    return [each for each in messages("mono8") if "camera_info" not in each[0]]


def test_a_bag_without_camera_info_takes_a_calibration_file(tmp_path: Path, bag: Path) -> None:
    path = write(tmp_path / "drive", sent=without_info())
    lacking = r"no such topic /left/camera_info .* type: none; .* --calibration FILE"
    with pytest.raises(InputError, match=lacking):
        read_recording("rosbag", path, settings())
    write_calibration(tmp_path / "pair.yaml")
    own = settings(calibration=str(tmp_path / "pair.yaml"))
    found = read_recording("rosbag", path, own, read_yaml)
    expected = read_recording("rosbag", bag, settings()).calibration
    assert (found.calibration.left, found.calibration.right) == (expected.left, expected.right)
    np.testing.assert_allclose(found.calibration.T_left_right, expected.T_left_right, atol=1e-12)


def test_compressed_topics_have_camera_info_one_level_up(tmp_path: Path) -> None:
    """As image_transport names them: /left/image/compressed beside /left/camera_info."""
    sent = [
        (f"{topic}/compressed" if topic.endswith("image") else topic, *rest)
        for topic, *rest in messages("compressed")
    ]
    path = write(tmp_path / "drive", sent=sent)
    topics = {f"{side}": f"/{side}/image/compressed" for side in SIDES}
    recording = read_recording("rosbag", path, settings(**topics))
    assert recording.calibration.left.focal_px == (CAMERA.focal_px,) * 2
    for found, image in zip(recording.pair(0), drive()[0], strict=True):
        np.testing.assert_array_equal(found, image)


@pytest.mark.parametrize("colours", [False, True])
def test_the_format_of_a_compressed_picture_tells_a_mosaic(colours: bool) -> None:
    """Red rises to the right and blue downwards; without demosaicing neighbours differ by much."""
    v, u = np.mgrid[:40, :60]
    rgb = np.stack([4 * u, 0 * u + 100, 6 * v], axis=-1).astype(np.uint8)
    mosaic = rgb[:, :, 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = rgb[::2, ::2, 0], rgb[1::2, 1::2, 2]
    picture = rgb[:, :, ::-1] if colours else mosaic
    data = cv2.imencode(".png", picture)[1].ravel()
    kind = T["sensor_msgs/msg/CompressedImage"]
    found = decode_image(kind(header(0, "c"), "bayer_rggb8; png compressed", data))
    luma = rgb @ [0.299, 0.587, 0.114]
    np.testing.assert_allclose(found[2:-2, 2:-2], luma[2:-2, 2:-2], atol=2)


def test_compressed_pictures_that_are_not_read_name_their_format() -> None:
    """A mosaic of an unknown order is no grey picture."""
    kind = T["sensor_msgs/msg/CompressedImage"]
    data = cv2.imencode(".jpg", np.zeros((20, 30), np.uint8))[1].ravel()
    with pytest.raises(InputError, match=r"encoding 'bayer_rggb12': is not read; known: mono8"):
        decode_image(kind(header(0, "c"), "bayer_rggb12; jpeg compressed", data))
    with pytest.raises(InputError, match=r"format 'h264': cannot be decoded"):
        decode_image(kind(header(0, "c"), "h264", data[2:]))


def test_eight_coefficients_are_the_rational_model(tmp_path: Path) -> None:
    """The raw lens bends points as the published formula does."""
    coefficients = np.array([0.3, -0.05, 1e-4, -2e-4, 0.01, 0.6, 0.02, 0.005])
    sent = messages("mono8")
    for _, kind, _, message in sent:
        if kind.endswith("CameraInfo"):
            object.__setattr__(message, "distortion_model", "rational_polynomial")
            object.__setattr__(message, "d", coefficients)
    path = write(tmp_path / "drive", sent=sent)
    lens = read_recording("rosbag", path, settings()).calibration.left
    assert lens.coefficients == tuple(coefficients)
    x, y = 0.3, -0.2
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    s = x * x + y * y
    radial = (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)
    bent = (
        x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
        y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
    )
    pixel = np.array([bent]) * lens.focal_px + lens.center_px
    np.testing.assert_allclose(lens.rays(pixel)[0], [x, y, 1.0], atol=1e-5)
    for _, kind, _, message in sent:
        if kind.endswith("CameraInfo") and "right" in message.header.frame_id:
            object.__setattr__(message, "d", np.ones(12))
    path = write(tmp_path / "wrong", sent=sent)
    with pytest.raises(InputError, match=r"camera_info of the right camera: .* 12 numbers"):
        read_recording("rosbag", path, settings())


def test_repeated_times_are_refused_or_dropped_and_counted(tmp_path: Path) -> None:
    sent = []
    for topic, kind, k, message in messages("mono8"):
        sent.append((topic, kind, k, message))
        if topic == "/left/image" and k > 0:
            sent.append((topic, kind, k, message))
    path = write(tmp_path / "drive", sent=sent)
    with pytest.raises(InputError, match="repeats the time before; --repeated first"):
        read_recording("rosbag", path, settings())
    recording = read_recording("rosbag", path, settings(repeated="first"))
    assert len(recording) == 3
    assert len(recording.dropped) == 1
    assert recording.dropped[0].startswith("2 pictures of /left/image that repeat the time")
