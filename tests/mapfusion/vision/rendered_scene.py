"""A stereo pair of textured planes with known depth, ray-cast in plain NumPy."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from mapfusion.camera import StereoCamera


def texture(
    rng: np.random.Generator, rows: int, columns: int, contrast: float = 45.0
) -> np.ndarray:
    """Grey levels (rows, columns) float64 with structure at several scales."""
    total = np.zeros((rows, columns))
    for sigma in (2.0, 5.0, 12.0):
        layer = cv2.GaussianBlur(rng.standard_normal((rows, columns)), (0, 0), sigma)
        total += layer / layer.std()
    return np.clip(128 + contrast * total / total.std(), 0, 255)


@dataclass
class Plane:
    """A rectangle with corner `origin` and unit directions `along` and `up`, in the world."""

    origin: np.ndarray
    along: np.ndarray
    up: np.ndarray
    size_m: tuple[float, float]
    picture: np.ndarray
    texels_per_m: float = 100.0
    normal: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.origin, self.along, self.up = (
            np.asarray(a, float) for a in (self.origin, self.along, self.up)
        )
        self.normal = np.cross(self.along, self.up)


def wall(
    rng: np.random.Generator,
    start: tuple[float, float],
    end: tuple[float, float],
    height_m: float = 2.5,
    base_m: float = 0.0,
    texels_per_m: float = 100.0,
    contrast: float = 45.0,
) -> Plane:
    """An upright wall between two points of the floor plan, from `base_m` up."""
    a, b = np.array([*start, base_m]), np.array([*end, base_m])
    length = float(np.linalg.norm(b - a))
    rows, columns = int(height_m * texels_per_m) + 1, int(length * texels_per_m) + 1
    picture = texture(rng, rows, columns, contrast)
    return Plane(a, (b - a) / length, (0, 0, 1), (length, height_m), picture, texels_per_m)


def _view(
    planes: list[Plane], camera: StereoCamera, eye: np.ndarray, yaw: float
) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    center_u, center_v = camera.center_px
    ray = np.stack(
        [
            np.ones(u.shape),
            -(u - center_u) / camera.focal_px,
            -(v - center_v) / camera.focal_px,
        ],
        -1,
    )
    cos, sin = np.cos(yaw), np.sin(yaw)
    ray = ray @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]]).T
    depth = np.full(u.shape, np.inf)
    grey = np.full(u.shape, 90.0)
    for plane in planes:
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (plane.origin - eye) @ plane.normal / (ray @ plane.normal)
        hit = eye + np.where(np.isfinite(z), z, -1.0)[..., None] * ray - plane.origin
        a, b = hit @ plane.along, hit @ plane.up
        length, height = plane.size_m
        seen = (z > 0.05) & (a >= 0) & (a <= length) & (b >= 0) & (b <= height) & (z < depth)
        sampled = cv2.remap(
            plane.picture.astype(np.float32),
            (a * plane.texels_per_m).astype(np.float32),
            (b * plane.texels_per_m).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        grey = np.where(seen, sampled, grey)
        depth = np.where(seen, z, depth)
    return grey, depth


def render(
    planes: list[Plane],
    camera: StereoCamera,
    T_world_robot: tuple[float, float, float] = (0.0, 0.0, 0.0),
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left and right uint8 images and the left depth (inf where nothing is)."""
    x, y, yaw = T_world_robot
    left_axis = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    middle = np.array([x, y, 0.0]) + camera.mount_x_m * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    middle[2] = camera.mount_z_m
    images = []
    for side in (0.5, -0.5):
        grey, seen_depth = _view(planes, camera, middle + side * camera.baseline_m * left_axis, yaw)
        if side > 0:
            depth = seen_depth
        if rng is not None:
            grey = grey + noise * rng.standard_normal(grey.shape)
        images.append(np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    return images[0], images[1], depth
