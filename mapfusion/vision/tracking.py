"""Tracking of features over consecutive frames.

Features of consecutive frames are linked by their descriptors. A track keeps the point of the wall
at its first corner: a corner detector finds another point when the robot comes nearer.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.descriptors import USURF, DescriptorKind, euclidean_distance_at
from mapfusion.geometry.numerics import Float, kernel, require_finite, require_shape
from mapfusion.parameters import Probability, Range, require_in_range
from mapfusion.vision.patch_alignment import Templates, fit_patches
from mapfusion.vision.visual_odometry import RigidMotion, estimate_rigid_motion

_PATCH_HALF_PX = 17  # holds a template's window after a magnification of 1.5
PATCH_SIDE_PX = 2 * _PATCH_HALF_PX + 1


def cut_patches(image: np.ndarray, uv_px: Float) -> np.ndarray:
    """Cut patches (N, P, P) around the pixels nearest to points (N, 2); border pixels repeat."""
    middle, around = np.rint(uv_px).astype(np.int64), np.arange(PATCH_SIDE_PX) - _PATCH_HALF_PX
    u, v = (middle[:, axis, None] + around for axis in (0, 1))
    rows, columns = (np.clip(at, 0, n - 1) for at, n in zip((v, u), image.shape, strict=True))
    return image[rows[:, :, None], columns[:, None, :]]


@dataclass(frozen=True)
class Features:
    """Matched and described corners of one frame, the strongest corner first.

    Attributes:
        uv_px: position in the left image, shape (N, 2).
        disparity_px: positive disparity, shape (N,).
        sigma_disparity_px: standard deviation of the disparity, shape (N,).
        descriptor: vectors of the descriptors, shape (N, D) float32.
        slope: change of the disparity along u and v on the corner's surface, shape (N, 2); None if
            unknown.
        patch: patches of the left image from `cut_patches`, shape (N, P, P) uint8. Without patches
            the tracked points are the corners themselves.
        kind: kind of the descriptors.
    """

    uv_px: Float
    disparity_px: Float
    sigma_disparity_px: Float
    descriptor: np.ndarray
    slope: Float | None = None
    patch: np.ndarray | None = None
    kind: DescriptorKind = USURF

    def __post_init__(self) -> None:
        n = len(self.uv_px)
        require_shape("uv_px", self.uv_px, (n, 2))
        require_shape("disparity_px", self.disparity_px, (n,))
        require_shape("sigma_disparity_px", self.sigma_disparity_px, (n,))
        require_shape("descriptor", self.descriptor, (n, self.kind.length))
        object.__setattr__(self, "kind", self.kind.on(self.descriptor))
        if self.slope is not None:
            require_shape("slope", self.slope, (n, 2))
            require_finite("slope", self.slope)
        if self.patch is not None:
            require_shape("patch", self.patch, (n, PATCH_SIDE_PX, PATCH_SIDE_PX))
        for name in ("uv_px", "disparity_px", "sigma_disparity_px", "descriptor"):
            require_finite(name, getattr(self, name))
        if np.any(self.disparity_px <= 0):
            raise ValueError("disparity_px: must be positive")

    def __len__(self) -> int:
        return len(self.uv_px)


@dataclass(frozen=True)
class TrackedPoints:
    """Point of the world that each feature of a frame stands for, and its first appearance.

    Attributes:
        uv_px: position of the point, which may differ from the feature's corner, shape (N, 2).
        disparity_px: disparity at the point, shape (N,).
        warp: linear map from the first image to this frame's image at the point, shape (N, 2, 2).
        first_px: disparity in the first image and its slopes along u and v, shape (N, 3).
        templates: windows of the first images of the points of this frame.
        template: row of each point in `templates`, shape (N,); -1 before `start` and without
            patches.
    """

    uv_px: Float
    disparity_px: Float
    warp: Float
    first_px: Float
    templates: Templates
    template: np.ndarray

    @classmethod
    def at_corners(cls, features: Features, templates: Templates) -> "TrackedPoints":
        """Make points at the corners of a frame, still without templates.

        `templates` are those of the frame before; they serve this frame, too.
        """
        uv, disparity = features.uv_px.copy(), features.disparity_px.copy()
        first, none = _disparity_planes(features, slice(None), disparity), np.full(len(uv), -1)
        return cls(uv, disparity, _identities(len(uv)), first, templates, none)

    def start(self, features: Features, rows: np.ndarray) -> None:
        """Start tracks at the corners of the features `rows`."""
        uv, disparity = features.uv_px[rows], features.disparity_px[rows]
        self.uv_px[rows], self.disparity_px[rows] = uv, disparity
        self.warp[rows] = _identities(len(rows))
        self.first_px[rows] = _disparity_planes(features, rows, disparity)
        self.template[rows] = -1
        if features.patch is not None:
            used = self.template[self.template >= 0]
            self.template[rows] = unused = self.templates.unused(used, len(rows))
            self.templates.fill(unused, features.patch[rows], uv - np.rint(uv))


def follow_points(
    points: TrackedPoints, before: Features, after: Features, source: np.ndarray
) -> tuple[TrackedPoints, np.ndarray]:
    """Find the points of a frame in the next frame.

    A point is fitted to the first image of its track. If that fails, for example because the robot
    has come too near, the point is fitted to the image before. The templates of `points` serve the
    new points, so `points` is not valid afterwards.

    Args:
        points: points of the frame before.
        before: features of the frame before.
        after: features of the next frame.
        source: row of `before` that each feature of `after` is linked to, or -1, shape (N,).

    Returns:
        Points of the next frame, at the corners where no point was found, and the mask of the found
        points, shape (N,) bool.
    """
    new, rows = TrackedPoints.at_corners(after, points.templates), np.flatnonzero(source >= 0)
    if before.patch is None or after.patch is None:
        return new, source >= 0

    # Fit to the first image.
    old = source[rows]
    corner, template = after.uv_px[rows], points.template[old]
    middle = np.rint(corner)
    start = corner + points.uv_px[old] - before.uv_px[old] - middle
    patch, warp = after.patch[rows], _affine_maps(points.warp[old], start)
    disparity, first = after.disparity_px[rows], points.first_px[old]
    bend = projective_terms(first, disparity)
    fits = fit_patches(points.templates, template, patch, warp, bend)

    # Fit the others to the image before, which replaces the first image of their tracks.
    again = np.flatnonzero(~fits)
    if len(again):
        last = old[again]
        beside = points.uv_px[last] - np.rint(before.uv_px[last])
        points.templates.fill(template[again], before.patch[last], beside)
        nearer = _affine_maps(_identities(len(again)), start[again])
        first[again] = _disparity_planes(before, last, points.disparity_px[last])
        bend = projective_terms(first[again], disparity[again])
        fits[again] = fit_patches(points.templates, template[again], patch[again], nearer, bend)
        warp[again] = nearer

    # The disparity at the point differs from that at the corner by the slope of the surface.
    uv = middle + warp[:, :, 2]
    if after.slope is not None:
        disparity = disparity + np.sum(after.slope[rows] * (uv - corner), axis=1)
    fits &= disparity > 0
    kept = rows[fits]
    new.uv_px[kept], new.disparity_px[kept] = uv[fits], disparity[fits]
    new.warp[kept], new.first_px[kept] = warp[fits, :, :2], first[fits]
    new.template[kept] = template[fits]
    is_found = np.zeros(len(after), dtype=bool)
    is_found[kept] = True
    return new, is_found


def projective_terms(first_px: Float, disparity_px: Float) -> Float:
    """Compute h of `patch_alignment.py`, the projective terms of a plane's homography.

    A point of disparity d has depth f B / d. A camera that is nearer by t sees the depth times
    d / d' = 1 - t d / (f B). The homography divides by this factor, which is linear in the image as
    d is. Relative to its value at the point it is 1 + h'x with h = -(d' / d - 1) grad d / d. The
    effect of rotations is at most the angle over the focal length and is neglected.

    Args:
        first_px: disparity d and its slopes in the earlier image, shape (N, 3).
        disparity_px: disparity d' in the later image, shape (N,).

    Returns:
        h per pixel, shape (N, 2).
    """
    d, slope = first_px[:, 0], first_px[:, 1:]
    return -((disparity_px / d - 1) / d)[:, None] * slope


def _disparity_planes(features: Features, rows: np.ndarray | slice, disparity_px: Float) -> Float:
    """Return disparities (N,) and the slopes of their surfaces, zero if unknown, as (N, 3)."""
    plane = np.zeros((len(disparity_px), 3))
    plane[:, 0] = disparity_px
    if features.slope is not None:
        plane[:, 1:] = features.slope[rows]
    return plane


def _identities(n: int) -> Float:
    """Return n identity matrices, shape (n, 2, 2)."""
    maps = np.zeros((n, 2, 2))
    maps[:, 0, 0] = maps[:, 1, 1] = 1.0
    return maps


def _affine_maps(linear: Float, translation: Float) -> Float:
    """Return affine maps (N, 2, 3) of linear maps (N, 2, 2) and translations (N, 2)."""
    return np.concatenate([linear, translation[:, :, None]], axis=2)


_NO_MATCH = -1
_LONGEST_PAUSE = 50.0  # steps; after a longer pause the limits exclude nothing


@dataclass(frozen=True)
class TrackParameters:
    """Parameters of tracking.

    Attributes:
        min_length: p, number of consecutive frames after which a track is a landmark.
        max_shift_u_px: largest motion along a row between two frames. A rotation moves all points:
            0.11 rad moves them by 63 px in the middle of the image and by 83 px at its edge. The
            default leaves a margin, because a frame without tracks has no visual odometry.
        max_shift_v_px: largest motion across rows; driving moves near points outwards.
        max_disparity_ratio: largest ratio of two disparities, by the robot's step at the smallest
            depth and by noise at the largest.
        max_descriptor_distance: largest distance of two descriptors of any kind; 0.8 is the median
            of different points.
        noise_grey: standard deviation of the noise of one image, grey levels.
        max_misfit_px: error of the point's position that the fit of its patch tolerates besides
            noise. A larger difference of the patches ends the track.
        rigid_probability: share of the correct links that pass the chi-square test against the
            robot's motion.
    """

    min_length: Annotated[int, Range(1, 1000, "frames")] = 3
    max_shift_u_px: Annotated[float, Range(0.1, 8192, "px")] = 120.0
    max_shift_v_px: Annotated[float, Range(0.1, 8192, "px")] = 25.0
    max_disparity_ratio: Annotated[float, Range(1.001, 100, "1")] = 1.3
    max_descriptor_distance: Annotated[float, Range(1e-3, 2, "1")] = 0.3
    noise_grey: Annotated[float, Range(0, 255, "grey levels")] = 2.0
    max_misfit_px: Annotated[float, Range(1e-3, 100, "px")] = 0.5
    rigid_probability: Probability = 0.999

    def __post_init__(self) -> None:
        require_in_range(self)


@dataclass(frozen=True)
class Tracks:
    """Tracks of the features of one frame.

    Attributes:
        track_id: unique number of each track, shape (N,) int64.
        length: number of consecutive frames up to this one, 1 for a new track, shape (N,) int64.
        uv_px: position of the track's point, shape (N, 2).
        disparity_px: disparity at the point, shape (N,).
        motion: motion since the frame before, in the axes of the robot; None for too few links.
    """

    track_id: np.ndarray
    length: np.ndarray
    uv_px: Float
    disparity_px: Float
    motion: RigidMotion | None = None


class Tracker:
    """Tracker of features over consecutive frames.

    Args:
        parameters: limits of the links.
        camera: the rectified pair.
        sigma_uv_px: standard deviation of a feature's position in the image.

    Attributes:
        parameters: limits of the links.
        points_m: points of the last frame in the robot frame, shape (N, 3), and their covariances,
            shape (N, 3, 3).
    """

    def __init__(
        self, parameters: TrackParameters, camera: StereoCamera, sigma_uv_px: float
    ) -> None:
        self.parameters = parameters
        self._camera = camera
        self._sigma_uv_px = sigma_uv_px
        self._previous: tuple[Features, TrackedPoints, Tracks] | None = None
        self.points_m: tuple[Float, Float] = np.empty((0, 3)), np.empty((0, 3, 3))
        self._next_id = 0

    def update(
        self, features: Features, steps: float = 1.0, R_after_before: Float | None = None
    ) -> Tracks:
        """Track the features of the next frame.

        Args:
            features: features of the frame.
            steps: time since the frame before, in usual frame intervals. The limits on shift and
                disparity grow with the time.
            R_after_before: known rotation of the robot since the frame before, in its axes, shape
                (3, 3). The limits on shifts are relative to the rotated points.
        """
        n = len(features)
        source = np.full(n, _NO_MATCH)
        track_id, length = np.empty(n, np.int64), np.ones(n, np.int64)
        if self._previous is None:
            templates = Templates.allocate(
                n, self.parameters.noise_grey, self.parameters.max_misfit_px
            )
            points, motion = TrackedPoints.at_corners(features, templates), None
            self.points_m = self._triangulate(points, features, slice(None))
        else:
            before, points_before, tracks = self._previous
            expected = before
            if R_after_before is not None:
                turned = self._camera.rotate_pixels(before.uv_px, R_after_before)
                expected = replace(before, uv_px=turned)
            source = link(expected, features, self.parameters, steps)
            points, is_found = follow_points(points_before, before, features, source)
            source[~is_found] = _NO_MATCH

            # Remove links that contradict the rigid motion; their features stand for the corners.
            rows = np.flatnonzero(source != _NO_MATCH)
            p_before, covariance_before = (values[source[rows]] for values in self.points_m)
            p, covariance = self._triangulate(points, features, slice(None))
            agree, motion = estimate_rigid_motion(
                p_before,
                covariance_before,
                p[rows],
                covariance[rows],
                self.parameters.rigid_probability,
            )
            removed = rows[~agree]
            source[removed] = _NO_MATCH
            if len(removed):
                p[removed], covariance[removed] = self._triangulate(features, features, removed)
            self.points_m = p, covariance
            linked = source != _NO_MATCH
            track_id[linked] = tracks.track_id[source[linked]]
            length[linked] += tracks.length[source[linked]]

        # Features without a link start new tracks.
        born = np.flatnonzero(source == _NO_MATCH)
        points.start(features, born)
        track_id[born] = np.arange(self._next_id, self._next_id + len(born))
        self._next_id += len(born)
        tracks = Tracks(track_id, length, points.uv_px, points.disparity_px, motion)
        self._previous = features, points, tracks
        return tracks

    def _triangulate(
        self, points: TrackedPoints | Features, features: Features, rows: np.ndarray | slice
    ) -> tuple[Float, Float]:
        """Return positions (N, 3) and covariances (N, 3, 3) of points in the robot frame."""
        return self._camera.triangulate(
            points.uv_px[rows],
            points.disparity_px[rows],
            self._sigma_uv_px,
            features.sigma_disparity_px[rows],
        )

    def landmarks(self, tracks: Tracks) -> np.ndarray:
        """Return the mask (N,) of the features whose track has lasted `min_length` frames."""
        return tracks.length >= self.parameters.min_length


def link(
    previous: Features, current: Features, parameters: TrackParameters, steps: float = 1.0
) -> np.ndarray:
    """Link the features of two frames.

    Two features are linked when each is the other's nearest descriptor within the limits on shift
    and disparity, and the distance of the descriptors is within its limit.

    Args:
        previous: features of the frame before.
        current: features of this frame.
        parameters: limits.
        steps: time between the frames, in usual frame intervals.

    Returns:
        Row in `previous` of each feature of `current`, or -1, shape (N,).
    """
    steps = min(steps, _LONGEST_PAUSE)
    unlike = euclidean_distance_at(parameters.max_descriptor_distance, previous.kind, current.kind)
    return _link_mutually(
        previous.uv_px,
        previous.disparity_px,
        previous.descriptor,
        current.uv_px,
        current.disparity_px,
        current.descriptor,
        steps * parameters.max_shift_u_px,
        steps * parameters.max_shift_v_px,
        parameters.max_disparity_ratio**steps,
        unlike**2,
    )


@kernel
def _link_mutually(
    previous_uv: np.ndarray,
    previous_disparity: np.ndarray,
    previous_descriptor: np.ndarray,
    uv: np.ndarray,
    disparity: np.ndarray,
    descriptor: np.ndarray,
    max_shift_u: float,
    max_shift_v: float,
    max_ratio: float,
    max_squared: float,
) -> np.ndarray:
    """Return the row of the previous feature that each feature is linked to, or -1, shape (N,)."""
    n, n_previous = len(uv), len(previous_uv)
    forward, forward_squared = np.full(n_previous, _NO_MATCH), np.full(n_previous, np.inf)
    backward, backward_squared = np.full(n, _NO_MATCH), np.full(n, np.inf)
    for i in range(n):
        for j in range(n_previous):
            if abs(uv[i, 0] - previous_uv[j, 0]) > max_shift_u:
                continue
            if abs(uv[i, 1] - previous_uv[j, 1]) > max_shift_v:
                continue
            ratio = disparity[i] / previous_disparity[j]
            if ratio > max_ratio or ratio * max_ratio < 1:
                continue
            squared = 0.0
            for k in range(descriptor.shape[1]):
                difference = descriptor[i, k] - previous_descriptor[j, k]
                squared += difference * difference
            if squared < backward_squared[i]:
                backward_squared[i], backward[i] = squared, j
            if squared < forward_squared[j]:
                forward_squared[j], forward[j] = squared, i
    for i in range(n):
        j = backward[i]
        if j != _NO_MATCH and (forward[j] != i or backward_squared[i] > max_squared):
            backward[i] = _NO_MATCH
    return backward
