"""Pictures as a sensor gives them: gain, offset and noise, rounded to whole grey levels.

A picture takes as many normal numbers as it has pixels, and to draw them takes longer than to draw
the picture. Sixteen random bits a pixel choose one of the equally likely values of a table instead:
it ends at 4.3 standard deviations, and between them differs from the normal law by less than
pixels are rounded.
"""

import functools

import numpy as np
from scipy.special import ndtri

from mapfusion.kernels import kernel
from sim.radiometry import RadiometricNoise

VALUES = 2**16
HALF = np.float32(0.5)  # keeps the sum in single precision


@functools.cache
def normal_values() -> np.ndarray:
    """Equally likely values (VALUES,) float32, ascending: normal, of mean 0 and variance 1."""
    quantiles = ndtri((np.arange(VALUES) + 0.5) / VALUES)
    return (quantiles / quantiles.std()).astype(np.float32)


def expose(gray: np.ndarray, noise: RadiometricNoise, rng: np.random.Generator) -> np.ndarray:
    """A noisy copy of a gray image (H, W) uint8."""
    gain = noise.gain * (1 + noise.sigma_gain * rng.standard_normal())
    offset = noise.sigma_offset_gray * rng.standard_normal()
    light = 255.0 ** (1 - noise.gamma) * np.arange(256.0) ** noise.gamma
    levels = (gain * light + offset).astype(np.float32)
    bits = draw_bits(gray.size, rng).reshape(gray.shape)
    return _exposed(gray, levels, bits, _deviations(noise.sigma_gray))


@functools.lru_cache(maxsize=1)
def _deviations(sigma_gray: float) -> np.ndarray:
    """Equally likely deviations (VALUES,) float32 of a pixel's grey level."""
    return np.float32(sigma_gray) * normal_values()


def draw_bits(n: int, rng: np.random.Generator) -> np.ndarray:
    """Numbers (n,) uint16, all equally likely; four from each of the generator's own words."""
    words = rng.integers(0, 2**64, -(-n // 4), dtype=np.uint64)
    return words.astype("<u8", copy=False).view("<u2")[:n]


@kernel
def _exposed(
    gray: np.ndarray, levels: np.ndarray, bits: np.ndarray, deviations: np.ndarray
) -> np.ndarray:
    """`levels` (256,) of what is seen plus `deviations` (VALUES,) that bits choose, rounded."""
    exposed = np.empty(gray.shape, dtype=np.uint8)
    seen = np.empty(gray.shape[1], dtype=np.float32)
    for v in range(gray.shape[0]):
        # what looks up and what reckons are apart, so that the latter runs in vectors
        for u in range(len(seen)):
            seen[u] = levels[gray[v, u]] + deviations[bits[v, u]]
        for u in range(len(seen)):
            level = min(max(seen[u], np.float32(0)), np.float32(255))
            exposed[v, u] = np.uint8(np.int32(level + HALF))
    return exposed
