"""Pictures of a tilted camera, out of what a level one sees from the same place.

The ray caster draws walls by columns and floors by rows, which only a level camera has. A camera
that turns about its optical centre sees the same rays elsewhere: a homography takes the picture of
a level camera, wide enough and twice as fine, to that of the tilted one.
"""

import math
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.kernels import kernel
from mapfusion.se2 import Float
from sim.depth_image import SAME_SURFACE
from sim.raycast.plan import Pinhole
from sim.stereo_head import NEAR_M

_FINER = 2  # pixels of the level picture, and samples of the tilted one, a pixel and axis
_BORDER_PX = 4.0  # of the level picture around what is needed: an interpolation's reach
_LEAST_AHEAD = 0.3  # of a ray's length: a level camera sees no farther to its sides, up and down


@dataclass(frozen=True)
class TiltedView:
    """A tilted camera, and the level one at its place.

    Attributes:
        size: width and height of the tilted one's pictures.
        level: the level one, which looks to where the tilted one's axis points in plan.
        to_level: (3, 3) from homogeneous pixels of the tilted one to rays of the level one: ahead,
            and the pixel times that.
    """

    size: tuple[int, int]
    level: Pinhole
    to_level: Float

    @classmethod
    def of(cls, camera: StereoCamera, T_world_camera: Float) -> Self:
        """The view of a camera at (4, 4), x along the optical axis; raises InputError."""
        R = T_world_camera[:3, :3]
        theta = math.atan2(R[1, 0], R[0, 0])
        cos, sin = math.cos(theta), math.sin(theta)
        R_level_camera = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) @ R
        width, height, f = camera.width_px, camera.height_px, camera.focal_px
        center_u, center_v = camera.center_px
        # from homogeneous pixels to rays x ahead, y left, z up
        ray_of = np.array([[0, 0, f], [-1, 0, center_u], [0, -1, center_v]]) / f
        ray_of = R_level_camera @ ray_of
        right, low = width - 0.5, height - 0.5
        corners = np.array([[u, v, 1.0] for u in (-0.5, right) for v in (-0.5, low)])
        ahead, left, up = ray_of @ corners.T
        if np.any(ahead < _LEAST_AHEAD * np.linalg.norm([ahead, left, up], axis=0)):
            raise InputError("raycast cannot draw what a camera sees that tilts so far")
        fine_px = float(_FINER * f)
        from_left, from_top = fine_px * left / ahead, fine_px * up / ahead
        u, v = float(from_left.max() + _BORDER_PX), float(from_top.max() + _BORDER_PX)
        size = [
            math.ceil(c + _BORDER_PX - low)
            for c, low in ((u, from_left.min()), (v, from_top.min()))
        ]
        x, y, z = T_world_camera[:3, 3].tolist()
        level = Pinhole(size[0], size[1], fine_px, u, v, x, y, z, theta, NEAR_M)
        pixel_of = np.array([[1, 0, 0], [u, -fine_px, 0], [v, 0, -fine_px]])
        return cls((width, height), level, pixel_of @ ray_of)

    def picture(self, level: np.ndarray) -> np.ndarray:
        """Grey levels (H, W) uint8 of the tilted camera, from those of the level one."""
        width, height = self.size
        first = 0.5 / _FINER - 0.5  # of a pixel's samples, from its middle
        pixel_of = np.array([[1 / _FINER, 0, first], [0, 1 / _FINER, first], [0, 0, 1]])
        rows = self.to_level[[1, 2, 0]]
        made = cv2.warpPerspective(
            level.astype(np.float32),
            rows @ pixel_of,
            (_FINER * width, _FINER * height),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        )
        mean = cv2.resize(made, (width, height), interpolation=cv2.INTER_AREA)
        return np.clip(np.rint(mean), 0, 255).astype(np.uint8)

    def depth_m(self, level: np.ndarray) -> np.ndarray:
        """Depth (H, W) float32 along the tilted axis, from that of the level one along its own."""
        width, height = self.size
        return _depths(level, self.to_level, height, width)


@kernel
def _depths(level: np.ndarray, to_level: Float, height: int, width: int) -> np.ndarray:
    """As `sim.depth_image.depth_at` at each pixel's place in the level image, tilted again."""
    depth_m = np.empty((height, width), dtype=np.float32)
    for j in range(height):
        for i in range(width):
            ahead = to_level[0, 0] * i + to_level[0, 1] * j + to_level[0, 2]
            u = (to_level[1, 0] * i + to_level[1, 1] * j + to_level[1, 2]) / ahead
            v = (to_level[2, 0] * i + to_level[2, 1] * j + to_level[2, 2]) / ahead
            k, m = int(u), int(v)
            a, b = u - k, v - m
            near, far, smooth = np.inf, 0.0, 0.0
            for row in range(2):
                for column in range(2):
                    own = level[m + row, k + column]
                    share = (b if row else 1 - b) * (a if column else 1 - a)
                    near, far = min(near, own), max(far, own)
                    smooth += share / own
            nearest = level[m + int(b > 0.5), k + int(a > 0.5)]
            # comparisons with NaN are false, so a pixel of the background makes an edge too
            one_surface = smooth == smooth and far - near <= SAME_SURFACE * nearest
            depth_m[j, i] = (1 / smooth if one_surface else nearest) / ahead
    return depth_m
