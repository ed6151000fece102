"""The points that tracks began with, followed from picture to picture."""

from dataclasses import dataclass

import numpy as np

from mapfusion.se2 import Float
from mapfusion.vision.features import Features
from mapfusion.vision.patch_fit import fit_patches
from mapfusion.vision.template import Templates


@dataclass(frozen=True)
class Likeness:
    """How a point's surroundings may differ from view to view, see `Templates.of`."""

    noise_grey: float
    max_misfit_px: float

    def templates(self, patch: np.ndarray, point: Float) -> Templates:
        """Of points (N, 2) in patches (N, P, P)."""
        return Templates.of(patch, point, self.noise_grey, self.max_misfit_px)


@dataclass(frozen=True)
class Followed:
    """Of each feature of one frame the point that it stands for, and how that looked at first.

    Attributes:
        uv_px: (N, 2) where the point lies, beside the feature's own corner.
        disparity_px: (N,) there.
        warp: (N, 2, 2) from how it looked at first to this frame's picture, at the point.
        first_px: (N, 3) its disparity at first, and the slopes of that along u and v.
        templates: how it looked; None without patches.
    """

    uv_px: Float
    disparity_px: Float
    warp: Float
    first_px: Float
    templates: Templates | None

    @classmethod
    def unseen(cls, features: Features) -> "Followed":
        """Points at the corners themselves, before `begin` says how they look."""
        templates = None if features.patch is None else Templates.room(len(features))
        uv, disparity = features.uv_px.copy(), features.disparity_px.copy()
        first = _plane(features, np.arange(len(uv)), disparity)
        return cls(uv, disparity, _upright(len(uv)), first, templates)

    def begin(self, features: Features, rows: np.ndarray, likeness: Likeness) -> None:
        """Let the corners of some features be points that are seen for the first time."""
        uv = features.uv_px[rows]
        self.uv_px[rows], self.disparity_px[rows] = uv, features.disparity_px[rows]
        self.warp[rows] = np.eye(2)
        self.first_px[rows] = _plane(features, rows, features.disparity_px[rows])
        if self.templates is not None and features.patch is not None:
            fresh = likeness.templates(features.patch[rows], uv - np.rint(uv))
            self.templates.put(rows, fresh, np.arange(len(rows)))


def followed(
    points: Followed, before: Features, after: Features, source: np.ndarray, likeness: Likeness
) -> tuple[Followed, np.ndarray]:
    """The points of the next frame, and which of its features are (N,) of points seen before.

    A point is fitted to the picture that its track began with; where that fails, as it does when
    the robot has come too near, to the picture before. The others are `unseen`.

    Args:
        points: of the frame before.
        before: that frame's features.
        after: the next frame's.
        source: (N,) row of `before` that each feature of `after` is linked to, or -1.
        likeness: beyond which two views show different points.
    """
    new, rows = Followed.unseen(after), np.flatnonzero(source >= 0)
    if before.patch is None or after.patch is None:
        return new, source >= 0
    assert points.templates is not None
    assert new.templates is not None
    old = source[rows]
    middle = np.rint(after.uv_px[rows])
    start = after.uv_px[rows] + points.uv_px[old] - before.uv_px[old] - middle
    shown, warp = after.patch[rows], _with_place(points.warp[old], start)
    now, first = after.disparity_px[rows], points.first_px[old]
    fits = fit_patches(points.templates, old, shown, warp, bend_of(first, now))
    again = np.flatnonzero(~fits)
    beside = points.uv_px[old[again]] - np.rint(before.uv_px[old[again]])
    nearer = likeness.templates(before.patch[old[again]], beside)
    from_nearer = _with_place(_upright(len(again)), start[again])
    first[again] = _plane(before, old[again], points.disparity_px[old[again]])
    bend = bend_of(first[again], now[again])
    fits[again] = fit_patches(nearer, np.arange(len(again)), shown[again], from_nearer, bend)
    warp[again] = from_nearer

    uv, disparity = middle + warp[:, :, 2], after.disparity_px[rows]
    if after.slope is not None:
        disparity = disparity + np.sum(after.slope[rows] * (uv - after.uv_px[rows]), axis=1)
    fits &= disparity > 0
    kept = rows[fits]
    new.uv_px[kept], new.disparity_px[kept] = uv[fits], disparity[fits]
    new.warp[kept], new.first_px[kept] = warp[fits, :, :2], first[fits]
    new.templates.put(kept, points.templates, old[fits])
    new.templates.put(rows[again[fits[again]]], nearer, np.flatnonzero(fits[again]))
    found = np.zeros(len(after), dtype=bool)
    found[kept] = True
    return new, found


def bend_of(first_px: Float, disparity_px: Float) -> Float:
    """(N, 2) h of `patch_fit.py`, per pixel: how the homography of a plane bends a window.

    A point of disparity d has depth f B / d, and by t nearer, d / d' = 1 - t d / (f B) of it. In
    the picture it is divided by that, which is linear in the image as d is, so that over its value
    at the point it is 1 + h'x with h = -(d' / d - 1) grad d / d. What turning bends, at most its
    angle over the focal length, is left out: no rotation is known yet, and it is far less.

    Args:
        first_px: (N, 3) disparity d and its slopes in the earlier picture.
        disparity_px: (N,) d' in the later one.
    """
    d, slope = first_px[:, 0], first_px[:, 1:]
    return -((disparity_px / d - 1) / d)[:, None] * slope


def _plane(features: Features, rows: np.ndarray, disparity_px: Float) -> Float:
    """(N, 3) disparities of some features' points, and the slopes of their surfaces."""
    slope = np.zeros((len(rows), 2)) if features.slope is None else features.slope[rows]
    return np.column_stack([disparity_px, slope])


def _upright(n: int) -> Float:
    return np.tile(np.eye(2), (n, 1, 1))


def _with_place(linear: Float, place: Float) -> Float:
    """Affine maps (N, 2, 3) of linear maps (N, 2, 2) and where the point lies (N, 2)."""
    return np.concatenate([linear, place[:, :, None]], axis=2)
