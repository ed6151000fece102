"""Maps as robots send them: a compact form, and messages with its changes.

A landmark takes 46 bytes without its descriptor, which is sent once. The shared errors of a map are
sent as drift at a few frames (`adoption.drift_of_map`), not for each landmark.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mapfusion.camera import CalibrationError
from mapfusion.descriptors import DescriptorKind
from mapfusion.fastslam.loop_closing import between_knots
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import IDENTITY, motion_jacobian
from mapfusion.landmark_map import LandmarkMap
from mapfusion.team.adoption import TimedMap, drift_of_map
from mapfusion.viewing import BEARINGS, FieldOfView, Viewing

# State of a landmark. The factor is the lower Cholesky factor of the covariance of its own error.
_LANDMARK = np.dtype(
    [
        ("source", "<i4"),
        ("position_m", "<f4", 3),
        ("factor_m", "<f2", 6),
        ("last_frame", "<i4"),
        ("label", "<i4"),
        ("count", "<u2"),
        ("direction_rad", "<f2"),
        ("distance_m", "<f4"),
        ("n_views", "<u2"),
    ]
)
# Pose of the robot in a frame, and range of the farthest landmark in each sector.
_FRAME = np.dtype([("pose", "<f4", 3), ("reach_m", "<f2", BEARINGS)])
_LARGEST_COUNT = np.iinfo(np.uint16).max
_STEPS = 127  # of a descriptor's largest number, in one byte
_LOWER = np.tril_indices(3)
# Added to covariances in m^2, so that those of planar maps have a factor.
_SMALLEST_M2 = 1e-12
# A landmark is sent again if it moved by this share of its standard deviation, or if its standard
# deviation changed by this share.
_CHANGED = 0.5
# A pose is sent again if it moved by more.
_MOVED_M, _MOVED_RAD = 0.02, 0.005


class MapHeader(NamedTuple):
    """Properties of a whole map.

    Attributes:
        name: name of the robot.
        planar: true for planar data.
        n_frames: number of frames of the log.
        calibration: calibration error of the camera.
        descriptor_kind: kind of the descriptors; None without any.
        labelled: true if landmarks have labels.
        field: field of view; None without viewing evidence.
        knots: frames of the drift, shape (K,).
        by_shared: drift by the shared variables, float16 of shape (K + 1, 3, R).
    """

    name: str
    planar: bool
    n_frames: int
    calibration: CalibrationError
    descriptor_kind: DescriptorKind | None
    labelled: bool
    field: FieldOfView | None
    knots: np.ndarray
    by_shared: np.ndarray

    @property
    def n_bytes(self) -> int:
        """Number of bytes; those of a few single values are not counted."""
        field = self.field
        n = 0 if field is None else 4 * (4 + field.height_m.size)
        return n + self.knots.astype(np.int32).nbytes + self.by_shared.nbytes


class CompactMap(NamedTuple):
    """Map of N landmarks from T frames.

    Attributes:
        header: properties of the map.
        landmarks: states in ascending order of `source`, shape (N,).
        descriptor: descriptors in steps of `scale`, int8 of shape (N, D); D is 0 without any.
        scale: float32 of shape (N,).
        frames: poses of the robot, and ranges, shape (T,).
    """

    header: MapHeader
    landmarks: np.ndarray
    descriptor: np.ndarray
    scale: np.ndarray
    frames: np.ndarray

    @classmethod
    def of(cls, timed: TimedMap) -> "CompactMap":
        """Return the compact form of a map with a joint covariance."""
        order = np.argsort(timed.landmarks.source_observation, kind="stable")
        given, last_frame = timed.landmarks, timed.last_frame[order]
        assert given.joint is not None
        joint, position = given.joint.leading[order], given.position_m[order]
        drift = drift_of_map(joint, position, last_frame, [(0, timed.n_frames - 1)])
        own_m2 = joint.own_m2 + drift.remainder_m2
        landmarks = np.zeros(len(given), dtype=_LANDMARK)
        landmarks["source"] = given.source_observation[order]
        landmarks["position_m"] = position
        factor = np.linalg.cholesky(own_m2 + _SMALLEST_M2 * np.eye(3))
        landmarks["factor_m"] = factor[:, *_LOWER]
        landmarks["last_frame"] = last_frame
        landmarks["count"] = np.minimum(given.count[order], _LARGEST_COUNT)
        if given.label is not None:
            landmarks["label"] = given.label[order]
        frames, field = np.zeros(0, dtype=_FRAME), None
        if given.viewing is not None:
            seen, field = given.viewing[order], given.viewing.field
            frames = np.zeros(len(seen.pose), dtype=_FRAME)
            frames["pose"], frames["reach_m"] = seen.pose, seen.reach_m
            landmarks["direction_rad"] = seen.direction_rad
            landmarks["distance_m"] = seen.distance_m
            landmarks["n_views"] = np.minimum(seen.n_views, _LARGEST_COUNT)
        described = np.zeros((len(given), 0)) if given.descriptor is None else given.descriptor
        described = described[order]
        scale = (np.abs(described).max(axis=1, initial=0.0) / _STEPS).astype(np.float32)
        steps = np.round(described / np.where(scale > 0, scale, 1)[:, None]).astype(np.int8)
        by_shared = drift.by_shared.astype(np.float16)
        about = (given.name, given.planar, timed.n_frames, given.calibration)
        about += (given.descriptor_kind, given.label is not None, field)
        header = MapHeader(*about, drift.knots, by_shared)
        return cls(header, landmarks, steps, scale, frames)

    def timed(self) -> TimedMap:
        """Return the map."""
        header, landmarks = self.header, self.landmarks
        n = len(landmarks)
        position = landmarks["position_m"].astype(np.float64)
        factor = np.zeros((n, 3, 3))
        factor[:, *_LOWER] = landmarks["factor_m"]
        if header.planar:
            factor[:, 2] = 0.0
        last_frame = landmarks["last_frame"].astype(np.int64)
        weight = between_knots(np.append(header.knots, header.n_frames - 1), last_frame)
        drift = np.einsum("nk,kir->nir", weight, header.by_shared.astype(np.float64))
        common_m = np.zeros((n, header.by_shared.shape[2], 3))
        common_m[:, :, :2] = np.swapaxes(motion_jacobian(IDENTITY, position) @ drift, 1, 2)
        joint = JointCovariance(factor @ np.swapaxes(factor, 1, 2), common_m)
        described = self.descriptor.astype(np.float32) * self.scale[:, None]
        viewing = None
        if header.field is not None:
            viewing = Viewing(
                landmarks["direction_rad"].astype(np.float64),
                landmarks["distance_m"].astype(np.float64),
                landmarks["n_views"].astype(np.int32),
                self.frames["pose"].astype(np.float64),
                self.frames["reach_m"].astype(np.float32),
                header.field,
            )
        received = LandmarkMap(
            position,
            joint.marginal_m2,
            landmarks["count"].astype(np.int32),
            landmarks["source"].astype(np.int64),
            described if described.shape[1] else None,
            landmarks["label"].astype(np.int32) if header.labelled else None,
            header.planar,
            header.name,
            joint,
            viewing,
            header.calibration,
            descriptor_kind=header.descriptor_kind,
        )
        return TimedMap(received, last_frame, header.n_frames)


@dataclass(frozen=True)
class MapMessage:
    """Changes between two versions of a map.

    Attributes:
        version: number of the map that the receiver has afterwards.
        base: number of the map that the receiver needs; 0 for none.
        header: properties of the map.
        landmarks: changed and new landmarks.
        is_new: true for the new ones among them.
        descriptor: descriptors of the new ones.
        scale: scale of these descriptors.
        removed: sources of landmarks that are no longer part of the map.
        frame: numbers of changed and new frames.
        frames: these frames.
        received: number of the last map that the sender has from each robot.
    """

    version: int
    base: int
    header: MapHeader
    landmarks: np.ndarray
    is_new: np.ndarray
    descriptor: np.ndarray
    scale: np.ndarray
    removed: np.ndarray
    frame: np.ndarray
    frames: np.ndarray
    received: Mapping[str, int]

    @property
    def n_bytes(self) -> int:
        """Number of bytes."""
        arrays = (self.landmarks, self.descriptor, self.scale, self.frames)
        numbers = 4 * (2 + len(self.removed) + len(self.frame) + len(self.received))
        return self.header.n_bytes + sum(array.nbytes for array in arrays) + numbers

    @classmethod
    def between(
        cls, old: CompactMap | None, new: CompactMap, versions: tuple[int, int]
    ) -> "MapMessage":
        """Return the message that turns one map into another.

        Args:
            old: map that the receiver has; None if it has none.
            new: the other map.
            versions: numbers of both.
        """
        if old is None:
            empty = (array[:0] for array in new[1:])
            old = CompactMap(new.header, *empty)
        known, row = _rows_of(old.landmarks["source"], new.landmarks["source"])
        was, now = old.landmarks[row[known]], new.landmarks[known]
        sigma_was, sigma_now = _sigma_m(was), _sigma_m(now)
        moved_m = np.linalg.norm(now["position_m"] - was["position_m"], axis=1)
        changed = moved_m > _CHANGED * sigma_now
        changed |= np.abs(sigma_now - sigma_was) > _CHANGED * sigma_was
        changed |= now["last_frame"] != was["last_frame"]
        sent = ~known
        sent[known] = changed
        is_new = ~known[sent]
        remains, _ = _rows_of(new.landmarks["source"], old.landmarks["source"])
        n = min(len(old.frames), len(new.frames))
        step = np.abs(new.frames["pose"][:n] - old.frames["pose"][:n])
        is_moved = np.any(step > [_MOVED_M, _MOVED_M, _MOVED_RAD], axis=1)
        frame = np.append(np.flatnonzero(is_moved), np.arange(n, len(new.frames)))
        return cls(
            versions[1],
            versions[0],
            new.header,
            new.landmarks[sent],
            is_new,
            new.descriptor[~known],
            new.scale[~known],
            old.landmarks["source"][~remains],
            frame,
            new.frames[frame],
            {},
        )

    def applied_to(self, old: CompactMap | None) -> CompactMap:
        """Return the receiver's map after this message."""
        n_descriptor = self.descriptor.shape[1]
        if old is None:
            nothing = np.zeros((0, n_descriptor), np.int8), np.zeros(0, np.float32)
            old = CompactMap(self.header, self.landmarks[:0], *nothing, self.frames[:0])
        keeps = ~np.isin(old.landmarks["source"], self.removed)
        landmarks, descriptor, scale = (array[keeps] for array in old[1:4])
        known, row = _rows_of(landmarks["source"], self.landmarks["source"])
        landmarks = landmarks.copy()
        landmarks[row[known]] = self.landmarks[known]
        fresh = self.is_new & ~known
        own = fresh[self.is_new]
        landmarks = np.concatenate([landmarks, self.landmarks[fresh]])
        descriptor = np.concatenate([descriptor, self.descriptor[own]])
        scale = np.concatenate([scale, self.scale[own]])
        order = np.argsort(landmarks["source"], kind="stable")
        frames = np.zeros(max(len(old.frames), self.frame.max(initial=-1) + 1), dtype=_FRAME)
        frames[: len(old.frames)] = old.frames
        frames[self.frame] = self.frames
        return CompactMap(self.header, landmarks[order], descriptor[order], scale[order], frames)

    def with_receipts(self, received: Mapping[str, int]) -> "MapMessage":
        """Return the message with numbers of the maps that its sender has."""
        return replace(self, received=dict(received))


def _rows_of(sources: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each of n wanted numbers is among ascending ones, and its row."""
    row = np.searchsorted(sources, wanted)
    known = row < len(sources)
    known[known] = sources[row[known]] == wanted[known]
    return known, row


def _sigma_m(landmarks: np.ndarray) -> Float:
    """Return the standard deviation of n landmarks, the root of the trace, shape (n,)."""
    return np.linalg.norm(landmarks["factor_m"].astype(np.float64), axis=1)
