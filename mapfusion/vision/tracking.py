"""Tracking of features over consecutive frames.

Features are linked by their descriptors. What is followed is the point of the wall that the track
began with: a corner detector finds another one as the robot draws near.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from mapfusion.geometry.camera import StereoCamera
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.parameters import Probability, Range, require_finite, require_in_range, require_shape
from mapfusion.tables import DESCRIPTOR_LENGTH
from mapfusion.vision.patch_alignment import Templates, fit_patches
from mapfusion.vision.visual_odometry import RigidMotion, estimate_rigid_motion

_PATCH_HALF_PX = 17  # room for a fit's window when what it shows has grown by half
PATCH_SIDE_PX = 2 * _PATCH_HALF_PX + 1


def cut_patches(image: np.ndarray, uv_px: Float) -> np.ndarray:
    """What is around the pixels nearest to points (N, 2), (N, P, P); outside the border repeats."""
    middle, around = np.rint(uv_px).astype(np.int64), np.arange(PATCH_SIDE_PX) - _PATCH_HALF_PX
    u, v = (middle[:, axis, None] + around for axis in (0, 1))
    rows, columns = (np.clip(at, 0, n - 1) for at, n in zip((v, u), image.shape, strict=True))
    return image[rows[:, :, None], columns[:, None, :]]


@dataclass(frozen=True)
class Features:
    """Matched and described corners of one frame, the strongest corner first.

    Attributes:
        uv_px: (N, 2) in the left image.
        disparity_px: (N,) positive.
        sigma_disparity_px: (N,) standard deviation of the disparity.
        descriptor: (N, 64) float32, unit length.
        slope: (N, 2) change of the disparity along u and v, on the corner's surface; None: none.
        patch: (N, P, P) uint8, what the left image shows around the pixel nearest to the corner,
            see `cut_patches`; None: corners are followed by their own places.
    """

    uv_px: Float
    disparity_px: Float
    sigma_disparity_px: Float
    descriptor: np.ndarray
    slope: Float | None = None
    patch: np.ndarray | None = None

    def __post_init__(self) -> None:
        n = len(self.uv_px)
        require_shape("uv_px", self.uv_px, (n, 2))
        require_shape("disparity_px", self.disparity_px, (n,))
        require_shape("sigma_disparity_px", self.sigma_disparity_px, (n,))
        require_shape("descriptor", self.descriptor, (n, DESCRIPTOR_LENGTH))
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
class Likeness:
    """How a point's surroundings may differ from view to view, see `Templates.of`."""

    noise_grey: float
    max_misfit_px: float

    def fill(self, templates: Templates, rows: np.ndarray, patch: np.ndarray, point: Float) -> None:
        """Put how points (N, 2) in patches (N, P, P) look into rows (N,) of templates."""
        templates.fill(rows, patch, point, self.noise_grey, self.max_misfit_px)


@dataclass(frozen=True)
class TrackedPoints:
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
    def unseen(cls, features: Features, templates: Templates) -> "TrackedPoints":
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


def follow_points(
    points: TrackedPoints, before: Features, after: Features, source: np.ndarray, likeness: Likeness
) -> tuple[TrackedPoints, np.ndarray]:
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
    new, rows = TrackedPoints.unseen(after, points.templates), np.flatnonzero(source >= 0)
    if before.patch is None or after.patch is None:
        return new, source >= 0
    old = source[rows]
    corner, template = after.uv_px[rows], points.template[old]
    middle = np.rint(corner)
    start = corner + points.uv_px[old] - before.uv_px[old] - middle
    shown, warp = after.patch[rows], _with_place(points.warp[old], start)
    now, first = after.disparity_px[rows], points.first_px[old]
    fits = fit_patches(points.templates, template, shown, warp, projective_terms(first, now))
    again = np.flatnonzero(~fits)
    if len(again):  # what a track began with has no use any more, whether this fits or not
        last = old[again]
        beside = points.uv_px[last] - np.rint(before.uv_px[last])
        likeness.fill(points.templates, template[again], before.patch[last], beside)
        nearer = _with_place(_upright(len(again)), start[again])
        first[again] = _plane(before, last, points.disparity_px[last])
        bend = projective_terms(first[again], now[again])
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


def projective_terms(first_px: Float, disparity_px: Float) -> Float:
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


_NO_MATCH = -1
_LONGEST_PAUSE = 50.0  # steps: after these no limit on shift or disparity is left


@dataclass(frozen=True)
class TrackParameters:
    """How features of consecutive frames are linked.

    Attributes:
        min_length: p, the frames in a row after which a track counts as a landmark.
        max_shift_u_px: largest motion along a row between two frames; turning moves all points:
            0.11 rad a frame by 63 px in the middle of the image and 83 px at its edge. Frames
            without tracks leave the heading to the odometry, so there is room above that.
        max_shift_v_px: across rows; driving moves near points outwards.
        max_disparity_ratio: largest change of disparity, as a factor: the robot's step against the
            nearest depth, and noise at the farthest.
        max_descriptor_distance: between unit vectors.
        noise_grey: noise of one image, grey levels; what residuals of a followed point's
            surroundings are held against.
        max_misfit_px: these may differ by noise and by what this error of the point's place would
            explain; what differs more begins a new track.
        rigid_probability: share of true links that agree with the robot's motion as far as noise
            lets them (chi-square); what agrees less is cut.
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
    """The tracks that a frame's features belong to.

    Attributes:
        track_id: (N,) int64, never used twice by one tracker.
        length: (N,) int64 frames in a row up to this one, 1 for a new track.
        uv_px: (N, 2) where the point lies that the track began with.
        disparity_px: (N,) there.
        motion: from the frame before, as the links tell it, in the axes of the robot; None where
            too few do.
    """

    track_id: np.ndarray
    length: np.ndarray
    uv_px: Float
    disparity_px: Float
    motion: RigidMotion | None = None


class Tracker:
    """Links each frame's features to those of the frame before; frames come in their order.

    `sigma_uv_px` is the standard deviation of a feature's place in the image.
    """

    def __init__(
        self, parameters: TrackParameters, camera: StereoCamera, sigma_uv_px: float
    ) -> None:
        self.parameters = parameters
        self._camera = camera
        self._sigma_uv_px = sigma_uv_px
        self._likeness = Likeness(parameters.noise_grey, parameters.max_misfit_px)
        self._previous: tuple[Features, TrackedPoints, Tracks] | None = None
        self._points_m = np.empty((0, 3)), np.empty((0, 3, 3))
        self._next_id = 0

    def update(
        self, features: Features, steps: float = 1.0, R_after_before: Float | None = None
    ) -> Tracks:
        """Tracks of this frame's features.

        `steps` is how many usual steps of time have passed since the frame before: after a pause
        the limits on shift and disparity allow as much more. `R_after_before` (3, 3) is by how much
        the robot is known to have tilted since, in its axes: limits on shifts count from there.
        """
        n = len(features)
        source, track_id, length = (
            np.full(n, _NO_MATCH),
            np.empty(n, np.int64),
            np.ones(n, np.int64),
        )
        if self._previous is None:
            points, motion = TrackedPoints.unseen(features, Templates.room(n)), None
            self._points_m = self._triangulated(points, features, slice(None))
        else:
            before, points_before, tracks = self._previous
            expected = before
            if R_after_before is not None:
                turned = self._camera.turned(before.uv_px, R_after_before)
                expected = replace(before, uv_px=turned)
            source = link(expected, features, self.parameters, steps)
            points, found = follow_points(points_before, before, features, source, self._likeness)
            source[~found] = _NO_MATCH
            motion = self._keep_rigid(points, features, source)
            linked = source != _NO_MATCH
            track_id[linked] = tracks.track_id[source[linked]]
            length[linked] += tracks.length[source[linked]]
        born = np.flatnonzero(source == _NO_MATCH)
        points.begin(features, born, self._likeness)
        track_id[born] = np.arange(self._next_id, self._next_id + len(born))
        self._next_id += len(born)
        made = Tracks(track_id, length, points.uv_px, points.disparity_px, motion)
        self._previous = features, points, made
        return made

    @property
    def points_m(self) -> tuple[Float, Float]:
        """Where the last frame's points lie in the robot frame (N, 3), and covariances."""
        return self._points_m

    def _keep_rigid(
        self, points: TrackedPoints, features: Features, source: np.ndarray
    ) -> RigidMotion | None:
        """Cut the links that the motion which explains most does not, and tell that motion.

        What was linked to nothing, or is no more, stands for its own corner.
        """
        rows = np.flatnonzero(source != _NO_MATCH)
        position_before, covariance_before = (values[source[rows]] for values in self._points_m)
        position, covariance = self._triangulated(points, features, slice(None))
        agree, motion = estimate_rigid_motion(
            position_before,
            covariance_before,
            position[rows],
            covariance[rows],
            self.parameters.rigid_probability,
        )
        cut = rows[~agree]
        source[cut] = _NO_MATCH
        if len(cut):
            position[cut], covariance[cut] = self._triangulated(features, features, cut)
        self._points_m = position, covariance
        return motion

    def _triangulated(
        self, points: TrackedPoints | Features, features: Features, rows: np.ndarray | slice
    ) -> tuple[Float, Float]:
        return self._camera.triangulate(
            points.uv_px[rows],
            points.disparity_px[rows],
            self._sigma_uv_px,
            features.sigma_disparity_px[rows],
        )

    def landmarks(self, tracks: Tracks) -> np.ndarray:
        """(N,) bool: features whose track has lasted `min_length` frames."""
        return tracks.length >= self.parameters.min_length


def link(
    previous: Features, current: Features, parameters: TrackParameters, steps: float = 1.0
) -> np.ndarray:
    """For each feature of `current` (N,) its row in `previous`, or -1.

    Two features are linked when each is the other's nearest descriptor among those that the limits
    on shift and disparity allow over so many steps, and the distance is within its limit.
    """
    steps = min(steps, _LONGEST_PAUSE)
    forward, backward = np.full(len(previous), _NO_MATCH), np.full(len(current), _NO_MATCH)
    _link(
        previous.uv_px,
        previous.disparity_px,
        previous.descriptor,
        current.uv_px,
        current.disparity_px,
        current.descriptor,
        steps * parameters.max_shift_u_px,
        steps * parameters.max_shift_v_px,
        parameters.max_disparity_ratio**steps,
        parameters.max_descriptor_distance**2,
        forward,
        np.full(len(previous), np.inf),
        backward,
        np.full(len(current), np.inf),
    )
    return backward


@kernel
def _link(
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
    forward: np.ndarray,
    forward_squared: Float,
    backward: np.ndarray,
    backward_squared: Float,
) -> None:
    """Fill in the links of both frames' features, which are none yet, and squared distances."""
    n = len(uv)
    for i in range(n):
        for j in range(len(previous_uv)):
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
