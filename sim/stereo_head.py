"""Stereo head: rectified pinhole cameras, their exposure and noise, and depth images.

Image noise needs a normal number per pixel, which takes longer than rendering. Instead 16 random
bits per pixel select one of the equally likely values of a table. The table ends at 4.3 standard
deviations; within these its error is below the rounding of pixels.
"""

import functools
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import scipy
from numpy.typing import ArrayLike

from mapfusion.camera import StereoCamera
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se3 import from_planar, pose
from mapfusion.parameters import Range, require_in_range
from sim.world import World


@dataclass(frozen=True)
class RadiometricNoise:
    """Sensor noise, independent in the two images of a pair.

    Attributes:
        sigma_gray: standard deviation of each pixel's additive noise, in gray levels of 255.
        gain: mean gain; below 1 the images are dark, while the noise stays the same.
        sigma_gain: standard deviation of an image's gain, relative to the mean gain.
        sigma_offset_gray: standard deviation of an image's offset, in gray levels.
        gamma: exponent of the light, over the full range, before the gain: above 1 it reduces the
            contrast of dark regions, below 1 that of bright ones.
    """

    sigma_gray: Annotated[float, Range(0, 255, "grey levels")] = 2.0
    sigma_gain: Annotated[float, Range(0, 10, "1")] = 0.01
    sigma_offset_gray: Annotated[float, Range(0, 255, "grey levels")] = 1.0
    gain: Annotated[float, Range(0, 10, "1")] = 1.0
    gamma: Annotated[float, Range(0.1, 10, "1")] = 1.0

    def __post_init__(self) -> None:
        require_in_range(self)


VALUES = 2**16
HALF = np.float32(0.5)  # keeps the sum in single precision


@functools.cache
def normal_values() -> np.ndarray:
    """Return equally likely values of a standard normal variable, ascending, shape (VALUES,)."""
    quantiles = scipy.special.ndtri((np.arange(VALUES) + 0.5) / VALUES)
    return (quantiles / quantiles.std()).astype(np.float32)


def expose(gray: np.ndarray, noise: RadiometricNoise, rng: np.random.Generator) -> np.ndarray:
    """Return a noisy copy of a gray image, shape (H, W) uint8."""
    gain = noise.gain * (1 + noise.sigma_gain * rng.standard_normal())
    offset = noise.sigma_offset_gray * rng.standard_normal()
    light = 255.0 ** (1 - noise.gamma) * np.arange(256.0) ** noise.gamma
    levels = (gain * light + offset).astype(np.float32)
    bits = draw_bits(gray.size, rng).reshape(gray.shape)
    return _add_noise(gray, levels, bits, np.float32(noise.sigma_gray) * normal_values())


def draw_bits(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return random numbers (n,) uint16; four from each 64-bit word of the generator."""
    words = rng.integers(0, 2**64, -(-n // 4), dtype=np.uint64)
    return words.astype("<u8", copy=False).view("<u2")[:n]


@kernel
def _add_noise(
    gray: np.ndarray, levels: np.ndarray, bits: np.ndarray, deviations: np.ndarray
) -> np.ndarray:
    """Return `levels` (256,) at gray values plus `deviations` (VALUES,) at bits, rounded."""
    exposed = np.empty(gray.shape, dtype=np.uint8)
    seen = np.empty(gray.shape[1], dtype=np.float32)
    for v in range(gray.shape[0]):
        # separate loops for look-up and arithmetic, so that the arithmetic is vectorised
        for u in range(len(seen)):
            seen[u] = levels[gray[v, u]] + deviations[bits[v, u]]
        for u in range(len(seen)):
            level = min(max(seen[u], np.float32(0)), np.float32(255))
            exposed[v, u] = np.uint8(np.int32(level + HALF))
    return exposed


SAME_SURFACE = 0.02  # larger relative depth differences separate two surfaces


def depth_at(depth_m: np.ndarray, uv_px: Float) -> Float:
    """Return depths (N,) of an image (H, W) at pixels (N, 2); NaN for the background.

    Between pixels of one surface the inverse depth is interpolated, which is linear in the image of
    a plane. At the edge of a surface the depth of the nearest pixel is returned.
    """
    height, width = depth_m.shape
    u, v = np.clip(np.asarray(uv_px, dtype=np.float64), 0, [width - 1.0, height - 1.0]).T
    i, j = np.minimum(v.astype(np.int64), height - 2), np.minimum(u.astype(np.int64), width - 2)
    a, b = u - j, v - i
    depth = np.stack([depth_m[i + r, j + q] for r in (0, 1) for q in (0, 1)]).astype(np.float64)
    weight = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    nearest = np.take_along_axis(depth, np.argmax(weight, axis=0)[None], axis=0)[0]
    with np.errstate(divide="ignore", invalid="ignore"):  # one over a depth of zero is infinite
        # comparisons with NaN are false, so a pixel of the background makes an edge too
        apart = depth.max(axis=0) - depth.min(axis=0)
        is_inside = (depth.sum(axis=0) > 0) & (apart <= SAME_SURFACE * nearest)
        p, q, r, s = weight / depth
        return np.where(is_inside, 1 / (p + q + r + s), nearest)


NEAR_M = 0.1  # below the distance from the lens to any wall
FAR_M = 100.0  # beyond the largest building's diagonal
LAMP_M = (0.0, 0.0, 1000.0)  # high enough for parallel light
BACKGROUND_M = 0.99 * FAR_M  # an untouched depth buffer is not exactly 1


@dataclass(frozen=True)
class StereoFrame:
    """Images of one robot at one time.

    Attributes:
        left: gray image, shape (H, W) uint8.
        right: gray image, shape (H, W) uint8.
        depth_m: depth along the optical axis of the left camera, shape (H, W) float32; NaN for the
            background.
        left_rgb: colour image without noise, shape (H, W, 3) uint8; None if not requested.
    """

    left: np.ndarray
    right: np.ndarray
    depth_m: np.ndarray
    left_rgb: np.ndarray | None


def render_stereo(
    world: World,
    camera: StereoCamera,
    T_world_robot: ArrayLike,
    noise: RadiometricNoise,
    rng: np.random.Generator,
) -> StereoFrame:
    """Render both images and the left depth of a robot at a pose (3,), or (4, 4) if it tilts."""
    left_rgba, buffer = _render(world, camera, T_world_robot, camera.baseline_m / 2)
    right_rgba, _ = _render(world, camera, T_world_robot, -camera.baseline_m / 2)
    left, right = (cv2.cvtColor(rgba, cv2.COLOR_RGBA2GRAY) for rgba in (left_rgba, right_rgba))
    left_rgb = cv2.cvtColor(left_rgba, cv2.COLOR_RGBA2RGB)
    depth = FAR_M * NEAR_M / (FAR_M - (FAR_M - NEAR_M) * buffer.astype(np.float64))
    depth[depth > BACKGROUND_M] = np.nan
    depth_m = depth.astype(np.float32)
    return StereoFrame(expose(left, noise, rng), expose(right, noise, rng), depth_m, left_rgb)


def _render(
    world: World, camera: StereoCamera, T_world_robot: ArrayLike, y_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return RGBA (H, W, 4) uint8 and the depth buffer (H, W) of a camera at lateral offset y."""
    p, tiny = world.bullet, world.renderer == "tiny"
    # EGL ignores light coefficients; a lamp along all normals shows the texture as painted
    lamp = {} if tiny else {"lightDirection": LAMP_M}
    # world to OpenGL's camera: x right, y up, z backwards
    T = camera_pose(camera, T_world_robot, y_m)
    ahead, left, up = T[:3, :3].T
    view = np.eye(4)
    view[:3, :3] = [-left, up, -ahead]
    view[:3, 3] = -view[:3, :3] @ T[:3, 3]
    # The principal point is at pixel (width - 1) / 2. OpenGL samples pixel i at the coordinate
    # i + 1/2 of a viewport with size `width`. TinyRenderer samples it at i, so the centre of its
    # frustum would be at width / 2; the matrix corrects this offset of half a pixel.
    off_px = 1 - 2 * (0.0 if tiny else 0.5)
    width, height, f = camera.width_px, camera.height_px, camera.focal_px
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[0, 2] = 2 * f / width, off_px / width
    matrix[1, 1], matrix[1, 2] = 2 * f / height, off_px / height
    matrix[2, 2] = -(FAR_M + NEAR_M) / (FAR_M - NEAR_M)
    matrix[2, 3] = -2 * FAR_M * NEAR_M / (FAR_M - NEAR_M)
    matrix[3, 2] = -1
    _, _, rgba, buffer, _ = p.getCameraImage(
        camera.width_px,
        camera.height_px,
        viewMatrix=view.T.ravel().tolist(),  # column by column
        projectionMatrix=matrix.T.ravel().tolist(),
        shadow=0,
        # ambient light only: a wall looks the same from all sides
        lightAmbientCoeff=1.0,
        lightDiffuseCoeff=0.0,
        lightSpecularCoeff=0.0,
        renderer=p.ER_TINY_RENDERER if tiny else p.ER_BULLET_HARDWARE_OPENGL,
        flags=p.ER_NO_SEGMENTATION_MASK,
        physicsClientId=world.client,
        **lamp,
    )
    shape = (camera.height_px, camera.width_px)
    return np.reshape(rgba, (*shape, 4)).astype(np.uint8, copy=False), np.reshape(buffer, shape)


def camera_pose(camera: StereoCamera, T_world_robot: ArrayLike, y_m: float) -> Float:
    """Return T_world_camera (4, 4): x along the optical axis, y left, z up.

    Args:
        camera: stereo pair and its mounting.
        T_world_robot: robot pose, shape (3,), or (4, 4) for a tilted body.
        y_m: offset of the camera to the left of the centre of the pair.
    """
    T_robot_camera = pose(camera.camera_axes, camera.p_robot_eye(y_m))
    return body_pose(T_world_robot) @ T_robot_camera


def body_pose(T_world_robot: ArrayLike) -> Float:
    """Return T_world_robot (4, 4) of a body at a pose (3,), or (4, 4) if it tilts."""
    T = np.asarray(T_world_robot, dtype=np.float64)
    return T if T.shape == (4, 4) else from_planar(T)
