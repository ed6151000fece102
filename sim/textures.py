"""Procedural textures: random shapes with corners at every scale, suited to nearest sampling.

PyBullet's renderer takes the nearest texel without a filter. Detail finer than a pixel's footprint
becomes noise that differs between the left and the right image, and texels larger than a pixel are
visible as steps. So the density matches the pixels at 2 to 3 m (577 px / 2.3 m = 250 per metre),
and a low pass removes detail that a pixel at 5 m does not resolve.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from mapfusion.errors import OutOfRangeError
from mapfusion.parameters import Range, require_in_range
from sim.floorplan import Face

_PosterSide = Annotated[float, Range(0.05, 10, "m")]


@dataclass(frozen=True)
class TextureStyle:
    """Texture statistics of one kind of face.

    Attributes:
        texels_per_m: density.
        scales_m: sizes of the shapes, painted from large to small.
        coverage: area painted at each scale over the face's area.
        contrast: range of gray levels at each scale, over the 8-bit range.
        low_pass_m: standard deviation of the Gaussian low pass.
    """

    texels_per_m: float
    scales_m: tuple[float, ...]
    coverage: tuple[float, ...]
    contrast: tuple[float, ...]
    low_pass_m: float


@dataclass(frozen=True)
class Texture:
    """Texture settings of a world, relative to `STYLES`.

    Attributes:
        contrast: factor on the contrast of the shapes; 0 leaves faces plain.
        coverage: factor on the number of shapes.
        bare: share of the wall faces that are left plain.
        posters: number of different posters. Each wall has posters side by side, drawn at random,
            so the same poster hangs in many places.
        poster_m: width and height of a poster.
        poster_width_m: range of the posters' width, in place of the width in `poster_m`; the seed
            draws one width for the world, uniformly on a logarithmic scale.
        poster_gap_m: gap between two posters.
    """

    contrast: Annotated[float, Range(0, 1, "1")] = 1.0
    coverage: Annotated[float, Range(0, 2, "1")] = 1.0
    bare: Annotated[float, Range(0, 1, "1")] = 0.0
    posters: Annotated[int, Range(0, 100, "posters")] = 0
    poster_m: tuple[_PosterSide, _PosterSide] = (1.2, 1.6)
    poster_width_m: tuple[_PosterSide, _PosterSide] | None = None
    poster_gap_m: Annotated[float, Range(0, 100, "m")] = 0.4

    def __post_init__(self) -> None:
        require_in_range(self)
        if self.poster_width_m is not None and self.poster_width_m[0] > self.poster_width_m[1]:
            low, high = self.poster_width_m
            said = f"is {low:g} to {high:g}, the smallest is above the largest"
            raise OutOfRangeError("poster_width_m", said)


DEFAULT_TEXTURE = Texture()

# Smallest wall shapes: 4 px at 8 m, 30 px at 1 m. Floor and ceiling are visible at grazing angles,
# where a pixel covers centimetres to decimetres, so they have coarse shapes only.
STYLES = {
    "wall": TextureStyle(
        texels_per_m=250,
        scales_m=(0.8, 0.4, 0.2, 0.1, 0.05),
        coverage=(0.7, 0.5, 0.4, 0.3, 0.12),
        contrast=(0.5, 0.8, 0.8, 0.8, 0.7),
        low_pass_m=0.008,
    ),
    "floor": TextureStyle(60, (1.6, 0.8, 0.4), (0.7, 0.5, 0.3), (0.3, 0.4, 0.4), 0.016),
    "ceiling": TextureStyle(60, (1.6, 0.8, 0.4), (0.7, 0.5, 0.3), (0.3, 0.4, 0.4), 0.016),
}

POSTER_FOOT_M = 0.2  # height of the lower edge; the level camera is at 0.45 m
TINT_LEVELS = 35  # colour serves people only; the cameras are gray
_SUBTEXEL_BITS = 4
_MOST_CORNERS = 6  # corners of a shape


def paint(
    face: Face,
    rng: np.random.Generator,
    texture: Texture = DEFAULT_TEXTURE,
    posters: Sequence[np.ndarray] = (),
) -> np.ndarray:
    """Return an RGB texture (H, W, 3) uint8 of a face, its first row along the upper edge.

    Args:
        face: the face.
        rng: random generator.
        texture: texture settings.
        posters: posters (from `paint_posters`), pasted if the face is a wall.
    """
    picture = _paint_shapes(face.kind, face.size_m, rng, texture)
    if face.kind != "wall" or not len(posters):
        return picture
    # as many posters, drawn at random, as fit side by side in the middle of the wall
    density = STYLES["wall"].texels_per_m
    height, width = posters[0].shape[:2]
    gap, foot = round(texture.poster_gap_m * density), round(POSTER_FOOT_M * density)
    n = (picture.shape[1] - gap) // (width + gap)
    if n < 1 or picture.shape[0] < foot + height:
        return picture
    first_column = (picture.shape[1] - n * (width + gap) + gap) // 2
    top = picture.shape[0] - foot - height
    for i, kind in enumerate(rng.integers(0, len(posters), n)):
        u = first_column + i * (width + gap)
        picture[top : top + height, u : u + width] = posters[kind]
    return picture


def paint_posters(texture: Texture, rng: np.random.Generator) -> list[np.ndarray]:
    """Return the posters of a world, painted like a wall with default settings."""
    poster_size_m = texture.poster_m
    if texture.poster_width_m is not None:
        poster_size_m = (
            float(np.exp(rng.uniform(*np.log(texture.poster_width_m)))),
            poster_size_m[1],
        )
    return [
        _paint_shapes("wall", poster_size_m, rng, DEFAULT_TEXTURE) for _ in range(texture.posters)
    ]


def _paint_shapes(
    kind: str, size_m: tuple[float, float], rng: np.random.Generator, texture: Texture
) -> np.ndarray:
    """Return an RGB texture (H, W, 3) uint8 of random shapes, painted from large to small."""
    style = STYLES[kind]
    width = max(8, round(size_m[0] * style.texels_per_m))
    height = max(8, round(size_m[1] * style.texels_per_m))
    picture = np.empty((height, width, 3), dtype=np.uint8)
    plain = _colours(1, 0.4, rng)[0].astype(np.uint8)
    picture[:] = plain
    # no random number without bare walls: the other settings keep their random sequence
    if texture.bare and kind == "wall" and rng.random() < texture.bare:
        return picture
    for scale_m, coverage, contrast in zip(
        style.scales_m, style.coverage, style.contrast, strict=True
    ):
        scale = scale_m * style.texels_per_m
        n = rng.poisson(coverage * texture.coverage * width * height / scale**2)
        # n convex polygons of about this size at random positions
        center = rng.uniform((0, 0), (width, height), (n, 2))
        corners = rng.integers(3, _MOST_CORNERS + 1, n)
        radius = 0.5 * scale * rng.uniform(0.6, 1.3, n)
        stretch = rng.uniform(0.5, 1.0, n)
        turn = rng.uniform(0, 2 * np.pi, (n, 2))
        jitter = rng.uniform(-0.3, 0.3, (n, _MOST_CORNERS))
        colour = _colours(n, contrast, rng).tolist()
        # all polygons have `_MOST_CORNERS` corners; only the first `corners` of each are painted
        share = (np.arange(_MOST_CORNERS) + jitter) / corners[:, None]
        angle = turn[:, :1] + 2 * np.pi * share
        x, y = np.cos(angle), stretch[:, None] * np.sin(angle)
        cos, sin = np.cos(turn[:, 1:]), np.sin(turn[:, 1:])
        turned = np.stack([cos * x - sin * y, sin * x + cos * y], -1)
        points = center[:, None] + radius[:, None, None] * turned
        fixed_point = np.round(points * 2**_SUBTEXEL_BITS).astype(np.int32)
        for polygon, k, rgb in zip(fixed_point, corners.tolist(), colour, strict=True):
            cv2.fillConvexPoly(picture, polygon[:k], rgb, cv2.LINE_8, _SUBTEXEL_BITS)
    if texture.contrast < 1:
        above = picture.astype(np.float32) - plain
        picture = np.rint(plain + texture.contrast * above).astype(np.uint8)
    return cv2.GaussianBlur(picture, (0, 0), style.low_pass_m * style.texels_per_m)


def _colours(n: int, contrast: float, rng: np.random.Generator) -> np.ndarray:
    """Return random colours (n, 3) with a slight tint."""
    gray = 127.5 + 127.5 * contrast * rng.uniform(-1, 1, (n, 1))
    return np.clip(gray + rng.normal(0, TINT_LEVELS, (n, 3)), 10, 245)
