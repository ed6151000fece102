"""What messages of ROS hold, as this library has it: pictures, lenses, poses, frames."""

from typing import Any

import cv2
import numpy as np

from mapfusion import se3
from mapfusion.errors import InputError
from mapfusion.recordings.lens import Distortion, Lens, StereoCalibration
from mapfusion.se2 import Float

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


def picture(message: Any) -> np.ndarray:
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


def calibration(left: Any, right: Any, rectified: bool) -> StereoCalibration:
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


def pose(message: Any) -> Float:
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


def chained(transforms: list[Any], target: str, source: str) -> Float | None:
    """T_target_source (4, 4) through a tree of TransformStamped; None where it leads nowhere."""
    parent = {_frame(t.child_frame_id): (_frame(t.header.frame_id), pose(t)) for t in transforms}
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
