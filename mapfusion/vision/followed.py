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

    def fill(self, templates: Templates, rows: np.ndarray, patch: np.ndarray, point: Float) -> None:
        """Put how points (N, 2) in patches (N, P, P) look into rows (N,) of templates."""
        templates.fill(rows, patch, point, self.noise_grey, self.max_misfit_px)


@dataclass(frozen=True)
class Followed:
    """Of each feature of one frame the point that it stands for, and how that looked at first.

    Attributes:
        uv_px: (N, 2) where the point lies, beside the feature's own corner.
        disparity_px: (N,) there.
        warp: (N, 2, 2) from how it looked at first to this frame's picture, at the point.
        first_px: (N, 3) its disparity at first, and the slopes of that along u and v.
        templates: how points looked, those of this frame and of no other.
        template: (N,) which of them is a point's; -1 before `begin` says how it looks, and without
            patches.
    """

    uv_px: Float
    disparity_px: Float
    warp: Float
    first_px: Float
    templates: Templates
    template: np.ndarray

    @classmethod
    def unseen(cls, features: Features, templates: Templates) -> "Followed":
        """Points at the corners themselves, before `begin` says how they look.

        `templates` are those of the frame before, which go on into this one.
        """
        uv, disparity = features.uv_px.copy(), features.disparity_px.copy()
        first, none = _plane(features, slice(None), disparity), np.full(len(uv), -1)
        return cls(uv, disparity, _upright(len(uv)), first, templates, none)

    def begin(self, features: Features, rows: np.ndarray, likeness: Likeness) -> None:
        """Let the corners of some features be points that are seen for the first time."""
        uv, disparity = features.uv_px[rows], features.disparity_px[rows]
        self.uv_px[rows], self.disparity_px[rows] = uv, disparity
        self.warp[rows] = _upright(len(rows))
        self.first_px[rows] = _plane(features, rows, disparity)
        self.template[rows] = -1
        if features.patch is not None:
            used = self.template[self.template >= 0]
            self.template[rows] = fresh = self.templates.unused(used, len(rows))
            likeness.fill(self.templates, fresh, features.patch[rows], uv - np.rint(uv))


def followed(
    points: Followed, before: Features, after: Features, source: np.ndarray, likeness: Likeness
) -> tuple[Followed, np.ndarray]:
    """The points of the next frame, and which of its features are (N,) of points seen before.

    A point is fitted to the picture that its track began with; where that fails, as it does when
    the robot has come too near, to the picture before. The others are `unseen`. Of what `points`
    holds the templates go on, those of the frame before are lost.

    Args:
        points: of the frame before.
        before: that frame's features.
        after: the next frame's.
        source: (N,) row of `before` that each feature of `after` is linked to, or -1.
        likeness: beyond which two views show different points.
    """
    new, rows = Followed.unseen(after, points.templates), np.flatnonzero(source >= 0)
    if before.patch is None or after.patch is None:
        return new, source >= 0
    old = source[rows]
    corner, template = after.uv_px[rows], points.template[old]
    middle = np.rint(corner)
    start = corner + points.uv_px[old] - before.uv_px[old] - middle
    shown, warp = after.patch[rows], _with_place(points.warp[old], start)
    now, first = after.disparity_px[rows], points.first_px[old]
    fits = fit_patches(points.templates, template, shown, warp, bend_of(first, now))
    again = np.flatnonzero(~fits)
    if len(again):  # what a track began with has no use any more, whether this fits or not
        last = old[again]
        beside = points.uv_px[last] - np.rint(before.uv_px[last])
        likeness.fill(points.templates, template[again], before.patch[last], beside)
        nearer = _with_place(_upright(len(again)), start[again])
        first[again] = _plane(before, last, points.disparity_px[last])
        bend = bend_of(first[again], now[again])
        fits[again] = fit_patches(points.templates, template[again], shown[again], nearer, bend)
        warp[again] = nearer

    uv, disparity = middle + warp[:, :, 2], now
    if after.slope is not None:
        disparity = disparity + np.sum(after.slope[rows] * (uv - corner), axis=1)
    fits &= disparity > 0
    kept = rows[fits]
    new.uv_px[kept], new.disparity_px[kept] = uv[fits], disparity[fits]
    new.warp[kept], new.first_px[kept] = warp[fits, :, :2], first[fits]
    new.template[kept] = template[fits]
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


def _plane(features: Features, rows: np.ndarray | slice, disparity_px: Float) -> Float:
    """(N, 3) disparities of some features' points, and the slopes of their surfaces."""
    plane = np.zeros((len(disparity_px), 3))
    plane[:, 0] = disparity_px
    if features.slope is not None:
        plane[:, 1:] = features.slope[rows]
    return plane


def _upright(n: int) -> Float:
    maps = np.zeros((n, 2, 2))
    maps[:, 0, 0] = maps[:, 1, 1] = 1.0
    return maps


def _with_place(linear: Float, place: Float) -> Float:
    """Affine maps (N, 2, 3) of linear maps (N, 2, 2) and where the point lies (N, 2)."""
    return np.concatenate([linear, place[:, :, None]], axis=2)
