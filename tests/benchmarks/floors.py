"""Lower bounds of the stages' time per frame, from the work that they cannot avoid.

Each figure is that of the barest work that any implementation has to do, done by a library or a
loop with nothing around it. A stage at twice its floor has little left to be won; one at a hundred
times may have, or does more than its barest work: it is found out by a profile.
"""

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numba import njit

from mapfusion.camera import StereoCamera
from mapfusion.geometry.numerics import Float
from mapfusion.vision.harris import HarrisParameters
from mapfusion.vision.surf import LENGTH
from sim.p3at import P3at
from sim.world import PHYSICS_HZ, World

_FRAME_INTERVAL_S = 0.2
_PARTICLES, _SEEN = 200, 40  # observations that a frame of the suite has
_LANDMARKS = 1000  # of a map of the suite at its end
_EVALUATED_EVERY = 10  # frames
_PICTURES = 3  # left, right, and depth
_BYTES = 4 * LENGTH + 35 * 35 + 64  # of one feature: descriptor, patch, where it is
_ROUNDS = 30


def seconds_of(work: Callable[[], object]) -> float:
    """The least of some rounds, after one that compiles and fills caches."""
    work()
    times = []
    for _ in range(_ROUNDS):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return min(times)


def floors_ms() -> dict[str, float]:
    """Return the lower bound of each stage in ms per frame."""
    return {
        "drive": 1e3 * _physics_s(),
        "rendering": 1e3 * _looking_up_s(),
        "features": 1e3 * _corners_s(),
        "observed": 1e3 * _linking_s(_features(), _features()),
        "slam": 1e3 * _updates_s(),
        "match": 1e3 * _linking_s(_features(_LANDMARKS), _features(_LANDMARKS)) / _EVALUATED_EVERY,
    }


def _physics_s() -> float:
    """PyBullet's own steps of a robot that stands."""
    with World() as world:
        world.start_physics()
        P3at(world, np.zeros(3))
        return seconds_of(lambda: world.step(round(_FRAME_INTERVAL_S * PHYSICS_HZ)))


def _looking_up_s() -> float:
    """One look-up in a texture for each pixel."""
    camera, rng = StereoCamera(), np.random.default_rng(0)
    texture = rng.integers(0, 256, (2048, 2048), dtype=np.uint8).ravel()
    n = camera.width_px * camera.height_px
    along = np.linspace(0, len(texture) - 1, n).astype(np.int64)
    seen = np.empty(n, dtype=np.uint8)
    return _PICTURES * seconds_of(lambda: _look_up(texture, along, seen))


@njit(cache=True)
def _look_up(texture: np.ndarray, at: np.ndarray, seen: np.ndarray) -> None:
    for i in range(len(at)):
        seen[i] = texture[at[i]]


def _corners_s() -> float:
    """OpenCV's corner response of one picture, and the bytes of what is found there on disk."""
    camera, rng = StereoCamera(), np.random.default_rng(0)
    picture = rng.integers(0, 256, (camera.height_px, camera.width_px), dtype=np.uint8)
    found = bytes(_BYTES * HarrisParameters().max_corners)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "features"
        return seconds_of(lambda: (cv2.cornerHarris(picture, 3, 3, 0.04), file.write_bytes(found)))


def _features(n: int = HarrisParameters().max_corners) -> Float:
    return np.random.default_rng(0).normal(size=(n, LENGTH)).astype(np.float32)


def _linking_s(a: Float, b: Float) -> float:
    """All distances between two sets of descriptors: one product of matrices."""
    return seconds_of(lambda: a @ b.T)


def _updates_s() -> float:
    """Each particle's gain P (P + 1)^-1 for each observation: one inverse, one product of 3 x 3."""
    covariance = np.tile(np.eye(3), (_PARTICLES, _SEEN, 1, 1))
    gain = np.empty_like(covariance)
    return seconds_of(lambda: _gains(covariance, gain))


@njit(cache=True)
def _gains(P: Float, gain: Float) -> None:
    S, adjugate = np.empty((3, 3)), np.empty((3, 3))
    for m in range(P.shape[0]):
        for i in range(P.shape[1]):
            for r in range(3):
                for q in range(3):
                    S[r, q] = P[m, i, r, q] + (r == q)
            for r in range(3):
                for q in range(3):  # of the transpose, with rows and columns taken in a circle
                    a, b, c, d = (q + 1) % 3, (q + 2) % 3, (r + 1) % 3, (r + 2) % 3
                    adjugate[r, q] = S[a, c] * S[b, d] - S[a, d] * S[b, c]
            scale = 1 / (
                S[0, 0] * adjugate[0, 0] + S[0, 1] * adjugate[1, 0] + S[0, 2] * adjugate[2, 0]
            )
            for r in range(3):
                for q in range(3):
                    total = 0.0
                    for k in range(3):
                        total += P[m, i, r, k] * adjugate[k, q]
                    gain[m, i, r, q] = scale * total
