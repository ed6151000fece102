"""Stereo visual odometry by OpenCV: Lucas-Kanade tracking and PnP."""

import cv2
import numpy as np

from mapfusion.datasets.camera_calibration import R_ROBOT_OPTICAL
from mapfusion.datasets.stereo_import import StereoImport
from mapfusion.geometry import se3

_FOLLOW = {"winSize": (21, 21), "maxLevel": 4}
_LEAST_DISPARITY_PX = 2.0
_MOST_BACK_PX, _MOST_ROWS_PX = (
    1.0,
    2.0,
)  # that points followed there and back, or across, may be off


def _followed(
    first: np.ndarray, second: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, p, None, **_FOLLOW)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, **_FOLLOW)
    near = np.abs(p - back).max(axis=(1, 2)) < _MOST_BACK_PX
    return there[:, 0], near & (found[:, 0] > 0) & (found_back[:, 0] > 0)


def correspondences(work: StereoImport, n_frames: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return points (N, 3) of each left camera and their pixels (N, 2) in the next frame."""
    camera, made = work.camera, []
    for k in range(n_frames - 1):
        left, right = work.rectified(k)
        p = cv2.goodFeaturesToTrack(left, 1000, 0.01, 10)
        across, seen = _followed(left, right, p)
        after, kept = _followed(left, work.rectified(k + 1)[0], p)
        own = p[:, 0]
        disparity = own[:, 0] - across[:, 0]
        level = np.abs(own[:, 1] - across[:, 1]) < _MOST_ROWS_PX
        good = seen & kept & level & (disparity > _LEAST_DISPARITY_PX)
        depth = camera.focal_px * camera.baseline_m / disparity[good]
        rays = (own[good] - np.array(camera.center_px)) / camera.focal_px
        points = np.column_stack([rays * depth[:, None], depth])
        made.append((points.astype(np.float64), after[good].astype(np.float64)))
    return made


def motions(
    work: StereoImport, pairs: list[tuple[np.ndarray, np.ndarray]], seed: int
) -> np.ndarray:
    """Return T_before_after (T - 1, 4, 4) of the robot for a seed of RANSAC."""
    camera = work.camera
    K = np.array(
        [[camera.focal_px, 0, camera.center_px[0]], [0, camera.focal_px, camera.center_px[1]],
         [0, 0, 1.0]]
    )  # fmt: skip
    T_robot_optical = work.T_robot_camera @ se3.pose(R_ROBOT_OPTICAL, np.zeros(3))
    cv2.setRNGSeed(seed)
    made = []
    for points, pixels in pairs:
        _, turn, shift, inside = cv2.solvePnPRansac(
            points, pixels, K, None, iterationsCount=500, reprojectionError=1.0
        )
        rows = inside[:, 0]
        turn, shift = cv2.solvePnPRefineLM(points[rows], pixels[rows], K, None, turn, shift)
        made.append(se3.inverse(se3.pose(cv2.Rodrigues(turn)[0], shift[:, 0])))
    return T_robot_optical @ np.array(made) @ se3.inverse(T_robot_optical)
