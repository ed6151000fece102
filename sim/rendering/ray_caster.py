"""Ray caster: images of a rectified stereo pair in a painted world with robots.

In plan a pixel column of a level camera is a wedge. It shows the nearest wall over the whole height
of the wall, the ceiling above and the floor below. So walls are drawn by columns and horizontal
planes by rows, each pixel as the mean over its footprint, and then the other robots over them. As
an alternative each pixel is the texel at its centre, as in PyBullet's TinyRenderer.

A tilted camera sees the same rays as a level camera with the same optical centre. A homography maps
the image of a level camera, wide enough and twice as fine, to that of the tilted one.
"""

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se3 import planar
from sim.p3at import URDF
from sim.rendering.floor_and_ceiling import (
    RayCoefficients,
    draw_plane,
    lookup_texels,
    ray_coefficients,
    row_depth_m,
)
from sim.rendering.robots import (
    ProjectedRobot,
    Solids,
    cast_rays,
    draw_robots,
    is_occluded,
    project_robot,
    read_solids,
    within_view,
)
from sim.rendering.scene import REFUSED, HorizontalPlane, Scene, Walls, read_scene
from sim.rendering.walls import (
    NO_WALL,
    Pinhole,
    VisibleWalls,
    at_origin,
    draw_walls,
    find_visible_walls,
)
from sim.stereo_head import (
    NEAR_M,
    SAME_SURFACE,
    RadiometricNoise,
    StereoFrame,
    body_pose,
    camera_pose,
    expose,
)


class VisibleScene(NamedTuple):
    """Geometry of a view, without colours.

    Attributes:
        camera: level camera.
        plan: visible walls.
        bodies: robots that walls do not hide, from the nearest to the farthest.
    """

    camera: Pinhole
    plan: VisibleWalls
    bodies: list[ProjectedRobot]


def find_visible(camera: Pinhole, walls: Walls, solids: Solids, poses: Float) -> VisibleScene:
    """Return the visible geometry of a scene with robots at poses (R, 3)."""
    visible_walls, bodies = find_visible_walls(camera, walls), list[ProjectedRobot]()
    for pose in within_view(camera, solids.reach_m, poses):
        if not is_occluded(camera, visible_walls, solids.reach_m, pose):
            bodies.append(project_robot(camera, solids, pose))
    return VisibleScene(camera, visible_walls, [body for body in bodies if len(body.shown)])


def render_filtered(visible: VisibleScene, scene: Scene, solids: Solids, grey: Float) -> np.ndarray:
    """Return grey levels (H, W) uint8, each the mean over the pixel's footprint.

    Args:
        visible: visible geometry.
        scene: static scene.
        solids: solids of one robot.
        grey: grey levels of the solids, shape (S,).
    """
    camera, visible_walls = visible.camera, visible.plan
    picture = np.empty((camera.height_px, camera.width_px), dtype=np.uint8)
    draw_plane(camera, scene.ceiling, True, visible_walls.above, picture)
    draw_plane(camera, scene.floor, False, visible_walls.below, picture)
    # walls are drawn by columns, which are not contiguous in an image
    columns = cv2.transpose(picture)
    draw_walls(camera, scene.walls, visible_walls, columns)
    picture = cv2.transpose(columns)
    if visible.bodies:
        draw_robots(camera, visible_walls, solids, visible.bodies, grey, picture)
    return picture


def render_depth(visible: VisibleScene, scene: Scene, solids: Solids) -> np.ndarray:
    """Return depths (H, W) float32 along the optical axis at pixel centres; NaN for background."""
    depth_m = _static_depth(visible, scene)
    cast_rays(visible.camera, solids, visible.bodies, np.zeros(len(solids.rgb)), depth_m)
    if np.any(visible.plan.middle == NO_WALL):
        depth_m[np.isinf(depth_m)] = np.nan
    return depth_m


def _static_depth(visible: VisibleScene, scene: Scene) -> np.ndarray:
    """Return depths (H, W) of the static scene; infinity for the background."""
    camera, visible_walls = visible.camera, visible.plan
    levels_m = _depths_of_levels(at_origin(camera), scene.floor.height_m, scene.ceiling.height_m)
    depth_m = np.empty((camera.height_px, camera.width_px), dtype=np.float32)
    np.minimum(
        visible_walls.middle_m.astype(np.float32), levels_m.astype(np.float32)[:, None], out=depth_m
    )
    beside = np.flatnonzero(visible_walls.middle == NO_WALL)
    if len(beside):  # only columns without a wall show the edge of floor or ceiling
        for level, rows in _sides(camera, scene):
            z = levels_m[rows, None]
            right, up = (
                _along(coefficients, beside, z) for coefficients in ray_coefficients(camera, level)
            )
            inside = (right >= 0) & (right < 1) & (up >= 0) & (up < 1)
            depth_m[rows, beside] = np.where(inside, z, np.inf)
    return depth_m


@functools.lru_cache(maxsize=1)
def _depths_of_levels(camera: Pinhole, floor_m: float, ceiling_m: float) -> Float:
    """Return depths (H,) of floor and ceiling at two heights in a scene without walls."""
    v = np.arange(camera.height_px)
    height_m = np.where(v < camera.center_v, ceiling_m, floor_m)
    return row_depth_m(camera, height_m, v)


def _sides(camera: Pinhole, scene: Scene) -> list[tuple[HorizontalPlane, slice]]:
    """Return ceiling and floor with the rows on their side of the horizon."""
    horizon = min(max(math.ceil(camera.center_v), 0), camera.height_px)
    return [(scene.ceiling, slice(horizon)), (scene.floor, slice(horizon, camera.height_px))]


def render_sampled(visible: VisibleScene, scene: Scene, solids: Solids, grey: Float) -> np.ndarray:
    """Return grey levels (H, W) uint8 at pixel centres; arguments of `render_filtered`."""
    camera, visible_walls, walls, u = (
        visible.camera,
        visible.plan,
        scene.walls,
        np.arange(visible.camera.width_px),
    )
    face, wall_m = visible_walls.middle, visible_walls.middle_m
    wall_rows, size = visible_walls.seen[face], walls.size[face]
    levels_m = _depths_of_levels(at_origin(camera), scene.floor.height_m, scene.ceiling.height_m)
    texel_column = np.where(
        face == NO_WALL, 0.0, (wall_rows[:, 4] + wall_rows[:, 5] * u) * wall_m - wall_rows[:, 6]
    )
    right = np.clip(texel_column / walls.width_m[face] * size[:, 0], 0, size[:, 0] - 1).astype(
        np.int64
    )
    first = walls.first[face] + right * (size[:, 1] + 1)
    picture = np.empty((camera.height_px, camera.width_px), dtype=np.uint8)
    # floor and ceiling
    for level, rows in _sides(camera, scene):
        to_right, to_up = (
            _along(coefficients, u, levels_m[rows, None])
            for coefficients in ray_coefficients(camera, level)
        )
        picture[rows] = lookup_texels(level, to_right, to_up)
    # walls in front of them: a texel is a difference of four sums
    v, j = np.nonzero(wall_m < levels_m[:, None])
    height_m = camera.eye_z_m - (v - camera.center_v) * wall_m[j] / camera.focal_px
    texel_row = (height_m / walls.height_m * size[j, 1]).astype(np.int64)
    here = first[j] + np.minimum(texel_row, size[j, 1] - 1)
    there, sums = here + size[j, 1] + 1, walls.sums
    picture[v, j] = sums[there + 1] - sums[there] - sums[here + 1] + sums[here]
    cast_rays(camera, solids, visible.bodies, grey, _static_depth(visible, scene), picture)
    return picture


def _along(coefficients: RayCoefficients, u: np.ndarray, z: Float) -> Float:
    """Return texture coordinates of rays at depths, see `ray_coefficients`; NaN at infinity."""
    with np.errstate(invalid="ignore"):
        return coefficients[0] + (coefficients[1] + coefficients[2] * u) * z


_FINER = 2  # resolution of the level image, and samples of the tilted image, per pixel and axis
_BORDER_PX = 4.0  # margin of the level image: reach of the interpolation
_LEAST_AHEAD = (
    0.3  # least depth of a ray of unit length: bounds the angle of view of the level camera
)


@dataclass(frozen=True)
class TiltedView:
    """Tilted camera, and a level camera with the same optical centre.

    Attributes:
        size: width and height of the tilted camera's images.
        level: level camera, whose axis is that of the tilted camera in plan.
        to_level: homography, shape (3, 3), from homogeneous pixels of the tilted camera to depth,
            and pixel times depth, of the level camera.
    """

    size: tuple[int, int]
    level: Pinhole
    to_level: Float

    @classmethod
    def of(cls, camera: StereoCamera, T_world_camera: Float) -> Self:
        """Return the view of a camera at a pose (4, 4), x along the optical axis.

        Raises:
            InputError: the camera tilts too far.
        """
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
        """Return the tilted camera's grey levels (H, W) uint8 from those of the level camera."""
        width, height = self.size
        first = 0.5 / _FINER - 0.5  # offset of a pixel's first sample from its centre
        pixel_of = np.array([[1 / _FINER, 0, first], [0, 1 / _FINER, first], [0, 0, 1]])
        rows = self.to_level[[1, 2, 0]]
        warped = cv2.warpPerspective(
            level.astype(np.float32),
            rows @ pixel_of,
            (_FINER * width, _FINER * height),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        )
        mean = cv2.resize(warped, (width, height), interpolation=cv2.INTER_AREA)
        return np.clip(np.rint(mean), 0, 255).astype(np.uint8)

    def depth_m(self, level: np.ndarray) -> np.ndarray:
        """Return depths (H, W) float32 along the tilted axis from those of the level camera."""
        width, height = self.size
        return _tilted_depth(level, self.to_level, height, width)


@kernel
def _tilted_depth(level: np.ndarray, to_level: Float, height: int, width: int) -> np.ndarray:
    """Return `sim.stereo_head.depth_at` at each pixel's position in the level image, tilted."""
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
                    depth = level[m + row, k + column]
                    weight = (b if row else 1 - b) * (a if column else 1 - a)
                    near, far = min(near, depth), max(far, depth)
                    smooth += weight / depth
            nearest = level[m + int(b > 0.5), k + int(a > 0.5)]
            # comparisons with NaN are false, so the background has edges too
            one_surface = smooth == smooth and far - near <= SAME_SURFACE * nearest
            depth_m[j, i] = (1 / smooth if one_surface else nearest) / ahead
    return depth_m


Sampling = Literal["footprint", "middle"]


class RayCaster:
    """Renderer of a painted world with robots.

    Args:
        faces: folder that `sim.world.write_faces` wrote.
        camera: stereo camera of the robot.
        sampling: a pixel is the mean over its footprint, or the texel at its centre.

    Raises:
        InputError: the ray caster cannot draw the world or the camera's view.
        DamagedFileError: a file of the folder is missing or damaged.
    """

    def __init__(self, faces: Path, camera: StereoCamera, sampling: Sampling = "footprint") -> None:
        self._faces, self._camera, self._sampling = faces, camera, sampling
        self._scene = read_scene(faces)
        if camera.mount_z_m >= self._scene.walls.height_m:
            raise self._too_high(camera.mount_z_m)
        self._channels: list[Scene] = []
        self._solids = read_solids(URDF)
        rgb = self._solids.rgb.astype(np.uint8)[None]
        self._grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)[0].astype(np.float64)

    def stereo(
        self,
        T_world_robot: ArrayLike,
        others: ArrayLike,
        noise: RadiometricNoise,
        rng: np.random.Generator,
        colour: bool = False,
    ) -> StereoFrame:
        """Render both images and the left depth of a robot.

        Args:
            T_world_robot: robot pose, shape (3,), or (4, 4) for a tilted body.
            others: poses of the other robots, shape (R, 3).
            noise: sensor noise.
            rng: random generator.
            colour: True to render the left image in colour too.

        Raises:
            InputError: the camera is above the walls or tilts too far.
        """
        half_m, poses, body = self._camera.baseline_m / 2, _poses(others), body_pose(T_world_robot)
        view = self._view(body, half_m)
        visible = self._sight(view, poses)
        left, depth_m = (
            self._draw(self._scene, view, visible, self._grey),
            self._depth_m(view, visible),
        )
        right = self.grey(body, -half_m, poses)
        rgb = self.rgb(body, half_m, poses) if colour else None
        return StereoFrame(expose(left, noise, rng), expose(right, noise, rng), depth_m, rgb)

    def grey(self, T_world_robot: ArrayLike, y_m: float, others: ArrayLike) -> np.ndarray:
        """Return the grey image (H, W) uint8 of one camera.

        Args:
            T_world_robot: robot pose, shape (3,), or (4, 4) for a tilted body.
            y_m: offset of the optical centre to the left of the robot's axis.
            others: poses of the other robots, shape (R, 3).
        """
        view = self._view(T_world_robot, y_m)
        return self._draw(self._scene, view, self._sight(view, _poses(others)), self._grey)

    def rgb(self, T_world_robot: ArrayLike, y_m: float, others: ArrayLike) -> np.ndarray:
        """Return the colour image (H, W, 3) uint8; arguments as of `grey`."""
        if not self._channels:
            self._channels = [read_scene(self._faces, channel) for channel in range(3)]
        view = self._view(T_world_robot, y_m)
        visible, colours = self._sight(view, _poses(others)), self._solids.rgb.T
        drawn = [
            self._draw(scene, view, visible, colour)
            for scene, colour in zip(self._channels, colours, strict=True)
        ]
        return np.stack(drawn, -1)

    def depth_m(self, T_world_robot: ArrayLike, y_m: float, others: ArrayLike) -> np.ndarray:
        """Return depths (H, W) float32 at pixel centres; NaN for background; see `grey`."""
        view = self._view(T_world_robot, y_m)
        return self._depth_m(view, self._sight(view, _poses(others)))

    def _sight(self, view: Pinhole | TiltedView, poses: Float) -> VisibleScene:
        camera = view if isinstance(view, Pinhole) else view.level
        return find_visible(camera, self._scene.walls, self._solids, poses)

    def _depth_m(self, view: Pinhole | TiltedView, visible: VisibleScene) -> np.ndarray:
        depth_m = render_depth(visible, self._scene, self._solids)
        return depth_m if isinstance(view, Pinhole) else view.depth_m(depth_m)

    def _draw(
        self, scene: Scene, view: Pinhole | TiltedView, visible: VisibleScene, grey: Float
    ) -> np.ndarray:
        kind = render_filtered if self._sampling == "footprint" else render_sampled
        drawn = kind(visible, scene, self._solids, grey)
        return drawn if isinstance(view, Pinhole) else view.picture(drawn)

    def _view(self, T_world_robot: ArrayLike, y_m: float) -> Pinhole | TiltedView:
        """Return the view of a level or a tilted camera."""
        T = camera_pose(self._camera, T_world_robot, y_m)
        eye_z_m = float(T[2, 3])
        if eye_z_m >= self._scene.walls.height_m:
            raise self._too_high(eye_z_m)
        if T[2, 0] or T[2, 1]:
            return TiltedView.of(self._camera, T)
        camera, theta = self._camera, float(np.arctan2(T[1, 0], T[0, 0]))
        size, x, y = (camera.width_px, camera.height_px), float(T[0, 3]), float(T[1, 3])
        focal_px = float(camera.focal_px)
        return Pinhole(*size, focal_px, *camera.center_px, x, y, eye_z_m, theta, NEAR_M)

    def _too_high(self, eye_z_m: float) -> InputError:
        top_m = self._scene.walls.height_m
        return InputError(REFUSED.format(what=f"from {eye_z_m:g} m above walls of {top_m:g} m"))


def _poses(others: ArrayLike) -> Float:
    """Return poses (R, 3) of robots, which are drawn upright even if they tilt."""
    poses = np.asarray(others, dtype=np.float64)
    return np.ascontiguousarray(planar(poses) if poses.ndim == 3 else poses).reshape(-1, 3)
