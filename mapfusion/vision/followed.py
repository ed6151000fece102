"""The points that tracks began with, followed from picture to picture."""

from dataclasses import dataclass

import numpy as np

from mapfusion.se2 import Float
from mapfusion.vision.features import Features
from mapfusion.vision.patch_fit import fit_patches


@dataclass(frozen=True)
class Followed:
    """Of each feature of one frame the point that it stands for, and how that looked at first.

    Attributes:
        uv_px: (N, 2) where the point lies, beside the feature's own corner.
        disparity_px: (N,) there.
        patch: (N, P, P) uint8 of the picture that the point is fitted to, None without patches.
        point_px: (N, 2) the point in it, from its middle.
        warp: (N, 2, 2) affine map from there to this frame's picture.
    """

    uv_px: Float
    disparity_px: Float
    patch: np.ndarray | None
    point_px: Float
    warp: Float


def begun(features: Features) -> Followed:
    """Points that have been seen in this frame only: the corners themselves."""
    uv, patch = features.uv_px.copy(), features.patch
    patch = None if patch is None else patch.copy()
    point, warp = uv - np.rint(uv), _upright(len(uv))
    return Followed(uv, features.disparity_px.copy(), patch, point, warp)


def followed(
    points: Followed,
    before: Features,
    after: Features,
    source: np.ndarray,
    noise: float,
    max_misfit: float,
) -> tuple[Followed, np.ndarray]:
    """The points of the next frame, and which of its features are (N,) of points seen before.

    A point is fitted to the picture that its track began with; where that fails, as it does when
    the robot has come too near, to the picture before.

    Args:
        points: of the frame before.
        before: that frame's features.
        after: the next frame's.
        source: (N,) row of `before` that each feature of `after` is linked to, or -1.
        noise: see `fit_patches`.
        max_misfit: likewise.
    """
    new, rows = begun(after), np.flatnonzero(source >= 0)
    if new.patch is None or before.patch is None or points.patch is None:
        return new, source >= 0
    old = source[rows]
    middle = np.rint(after.uv_px[rows])
    start = after.uv_px[rows] + points.uv_px[old] - before.uv_px[old] - middle
    patch, point = points.patch[old], points.point_px[old]
    warp = np.concatenate([points.warp[old], start[:, :, None]], axis=2)
    fits = fit_patches(patch, point, new.patch[rows], warp, noise, max_misfit)
    again = np.flatnonzero(~fits)
    patch[again] = before.patch[old[again]]
    point[again] = points.uv_px[old[again]] - np.rint(before.uv_px[old[again]])
    nearer = np.concatenate([_upright(len(again)), start[again, :, None]], axis=2)
    shown = new.patch[rows[again]]
    fits[again] = fit_patches(patch[again], point[again], shown, nearer, noise, max_misfit)
    warp[again] = nearer

    uv = middle + warp[:, :, 2]
    disparity = after.disparity_px[rows]
    if after.slope is not None:
        disparity = disparity + np.sum(after.slope[rows] * (uv - after.uv_px[rows]), axis=1)
    fits &= disparity > 0
    found = np.zeros(len(after), dtype=bool)
    found[rows[fits]] = True
    made = (uv, disparity, patch, point, warp[:, :, :2])
    for of_all, own in zip(vars(new).values(), made, strict=True):
        of_all[found] = own[fits]
    return new, found


def begin_again(points: Followed, features: Features, rows: np.ndarray) -> None:
    """Set points, in place, back to the corners of this frame's features."""
    for of_all, corners in zip(vars(points).values(), vars(begun(features)).values(), strict=True):
        if of_all is not None:
            of_all[rows] = corners[rows]


def _upright(n: int) -> Float:
    return np.tile(np.eye(2), (n, 1, 1))
