"""Slow reference: image of the painted room in an exact pinhole camera."""

from pathlib import Path

import cv2
import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.geometry.se2 import transform_points
from sim.floorplan import Face, FloorPlan
from sim.stereo_head import RadiometricNoise
from sim.world import face_files

CAMERA = StereoCamera()
NO_NOISE = RadiometricNoise(0, 0, 0)
POSE = np.array([1.2, 2.1, -0.35])  # sees two walls, the stub, floor and ceiling


def ray_cast(
    room: FloorPlan, folder: Path, y_m: float, shift_px: tuple[float, float] = (0, 0)
) -> np.ndarray:
    """RGB of the texel that each pixel's ray hits: pinhole geometry written out by hand."""
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px].astype(float)
    x, y, theta = POSE
    forward = np.array([np.cos(theta), np.sin(theta), 0])
    left, up = np.array([-np.sin(theta), np.cos(theta), 0]), np.array([0, 0, 1.0])
    to_left = (319.5 - u - shift_px[0]) / 577
    to_up = (239.5 - v - shift_px[1]) / 577
    ray = forward + to_left[..., None] * left + to_up[..., None] * up
    eye = np.array([x, y, 0]) + CAMERA.mount_x_m * forward + y_m * left + CAMERA.mount_z_m * up
    nearest = np.full(u.shape, np.inf)
    picture = np.zeros((*u.shape, 3), dtype=np.uint8)
    for i, face in enumerate(room.faces()):
        texture = cv2.imread(str(face_files(folder, i)[1]))[::-1, :, ::-1]
        height, width = texture.shape[:2]
        distance, right, upward = hit(face, eye, ray)
        seen = (distance > 0) & (distance < nearest)
        seen &= (right >= 0) & (right < 1) & (upward >= 0) & (upward < 1)
        nearest[seen] = distance[seen]
        row, column = (upward[seen] * height).astype(int), (right[seen] * width).astype(int)
        picture[seen] = texture[row, column]
    return picture


def hit(face: Face, eye: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth of the hit, and its place along the face's edges in 0..1; -1 from behind."""
    corner, right, up = face.corners_m[0], *(face.corners_m[[1, 3]] - face.corners_m[0])
    normal = np.cross(right, up)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(ray @ normal < 0, ((corner - eye) @ normal) / (ray @ normal), -1.0)
    point = eye + distance[..., None] * ray - corner
    return distance, point @ right / (right @ right), point @ up / (up @ up)


def off_surface_m(room: FloorPlan, camera: StereoCamera, depth_m: np.ndarray) -> np.ndarray:
    """Distance of each pixel's world point from the nearest face's plane."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px]
    p_robot = camera.back_project(np.stack([u.ravel(), v.ravel()], -1), depth_m.ravel())
    p_world = transform_points(POSE, p_robot)
    best = np.full(len(p_world), np.inf)
    for face in room.faces():
        corner, right, up = face.corners_m[0], *(face.corners_m[[1, 3]] - face.corners_m[0])
        normal = np.cross(right, up)
        best = np.minimum(best, np.abs((p_world - corner) @ normal) / np.linalg.norm(normal))
    return best
