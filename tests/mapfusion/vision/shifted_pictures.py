"""Stereo pairs whose disparity is known exactly at each pixel."""

import numpy as np

from mapfusion.camera import StereoCamera

CAMERA = StereoCamera(width_px=320, height_px=240, focal_px=300.0)


class Picture:
    """Brightness as a smooth function of the plane, so that it can be shifted exactly."""

    def __init__(self, seed: int, waves: int = 60) -> None:
        rng = np.random.default_rng(seed)
        self.frequency = rng.normal(0, 0.25, (waves, 2))
        self.phase = rng.uniform(0, 2 * np.pi, waves)

    def __call__(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        total = np.zeros(np.broadcast(u, v).shape)
        for (fu, fv), phase in zip(self.frequency, self.phase, strict=True):
            total += np.sin(fu * u + fv * v + phase)
        return 128 + 40 * total / np.sqrt(len(self.phase) / 2)


def pair(
    d: float,
    a: float = 0.0,
    b: float = 0.0,
    noise: float = 0.0,
    seed: int = 0,
    rows: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Left and right uint8 images with disparity d + a u + b v at each left pixel.

    What the right one shows lies `rows` lower there; only without a slope b.
    """
    u, v = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    picture, rng = Picture(seed), np.random.default_rng(seed)
    u_left = (u + d + b * v) / (1 - a)  # of what the right image shows at u
    shown = ((u, v), (u_left, v - rows))
    images = (picture(x, y) + noise * rng.standard_normal(u.shape) for x, y in shown)
    left, right = (np.clip(np.rint(i), 0, 255).astype(np.uint8) for i in images)
    return left, right


def grid(step: int = 12) -> np.ndarray:
    """Points with fractions, clear of the borders and of the largest disparity."""
    u, v = np.meshgrid(np.arange(70.3, 290, step), np.arange(25.6, 215, step))
    return np.stack([u.ravel(), v.ravel()], -1)
