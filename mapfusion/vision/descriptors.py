"""Descriptors of corners by name: U-SURF, SIFT and ORB, and those of other packages and files.

All describe an upright square window around a corner, whose side is 20 scales s. The scale follows
from the depth (see `USurfParameters`), so that a window covers the same area of a wall from
everywhere. OpenCV's own keypoint detectors are not used.

SIFT: Lowe (2004), "Distinctive image features from scale-invariant keypoints". ORB: Rublee, Rabaud,
Konolige and Bradski (2011), "ORB: an efficient alternative to SIFT or SURF".
"""

import math
from importlib.metadata import entry_points
from typing import Any, Protocol

import cv2
import numpy as np

from mapfusion.descriptors import USURF, DescriptorKind, Metric, as_vectors, require_metric
from mapfusion.errors import InputError, did_you_mean, moved_module_note, one_line
from mapfusion.geometry.numerics import Float
from mapfusion.plugin_classes import IN_FILE, load_class, target_in_file
from mapfusion.vision import surf

GROUP = "mapfusion.descriptors"  # entry points of other packages


class Describer(Protocol):
    """Interface of descriptors. The constructor has no arguments.

    Attributes:
        metric: metric of the distance of two descriptors.
    """

    metric: Metric

    def describe(self, image: np.ndarray, uv_px: Float, scale_px: Float) -> np.ndarray:
        """Compute the descriptors of the corners of one image.

        Args:
            image: shape (H, W) uint8.
            uv_px: positions, shape (N, 2); the centre of the top left pixel is (0, 0).
            scale_px: scale of each corner, shape (N,); the window's side is 20 scales.

        Returns:
            Descriptors in the order of the corners: (N, D) float32, or packed bits (N, B) uint8 for
            `hamming`.
        """
        ...


class USurf:
    """Upright SURF, 64 numbers (see `surf.py`)."""

    metric: Metric = USURF.metric
    length = USURF.length

    def describe(self, image: np.ndarray, uv_px: Float, scale_px: Float) -> np.ndarray:
        """Compute descriptors of unit norm; zero where the window is flat."""
        return surf.describe(image, uv_px, scale_px)


# Constants of OpenCV's SIFT: 4x4 cells of 3 keypoint radii, three layers in an octave, and the
# blur of the first image of an octave.
_SIFT_SIDE = 4 * 3 / 2  # of the window, in keypoint diameters
_SIFT_LAYERS = 3
_SIFT_SIGMA_PX = 1.6


class Sift:
    """SIFT of OpenCV, 128 numbers, upright."""

    metric: Metric = "euclidean"
    length = 128

    def __init__(self) -> None:
        self._sift = cv2.SIFT.create(nOctaveLayers=_SIFT_LAYERS, sigma=_SIFT_SIGMA_PX)

    def describe(self, image: np.ndarray, uv_px: Float, scale_px: Float) -> np.ndarray:
        """Compute descriptors of the image of the scale space that fits each window."""
        keypoints = []
        for k, ((u, v), scale) in enumerate(zip(uv_px.tolist(), scale_px.tolist(), strict=True)):
            size = surf.SAMPLES * scale / _SIFT_SIDE
            level = max(0.0, math.log2(size / (2 * _SIFT_SIGMA_PX)))
            octave = int(level)
            layer = round(_SIFT_LAYERS * (level - octave))
            keypoints.append(cv2.KeyPoint(u, v, size, 0.0, 1.0, octave | layer << 8, k))
        if not keypoints:
            return np.empty((0, self._sift.descriptorSize()), np.float32)
        kept, computed = self._sift.compute(image, keypoints)
        return _in_order(kept, computed, len(keypoints))


_ORB_SIDE_PX = 31  # of the patch
_ORB_STEP = 1.1  # ratio of two scales: those of one corner from two places differ by up to 5 %


class Orb:
    """ORB of OpenCV, 256 bits, upright."""

    metric: Metric = "hamming"
    length = 256

    def __init__(self) -> None:
        self._orb = cv2.ORB.create(nlevels=1, edgeThreshold=0, patchSize=_ORB_SIDE_PX)

    def describe(self, image: np.ndarray, uv_px: Float, scale_px: Float) -> np.ndarray:
        """Compute descriptors in copies of the image in which the windows have the patch's size."""
        descriptors = np.zeros((len(uv_px), self._orb.descriptorSize()), np.uint8)
        zoom = np.log(surf.SAMPLES * np.asarray(scale_px) / _ORB_SIDE_PX) / math.log(_ORB_STEP)
        level = np.rint(zoom).astype(np.int64)
        for each in np.unique(level).tolist():
            rows = np.flatnonzero(level == each)
            factor = _ORB_STEP**-each
            size = [max(1, round(n * factor)) for n in image.shape[::-1]]
            shape = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
            resized = cv2.resize(image, size, interpolation=shape)
            side = _ORB_SIDE_PX  # OpenCV drops corners near the border
            padded = cv2.copyMakeBorder(resized, side, side, side, side, cv2.BORDER_REPLICATE)
            ratio = np.array(size) / image.shape[::-1]
            at = (uv_px[rows] + 0.5) * ratio - 0.5 + _ORB_SIDE_PX
            keypoints = [
                cv2.KeyPoint(u, v, _ORB_SIDE_PX, 0.0, 1.0, 0, k)
                for k, (u, v) in enumerate(at.tolist())
            ]
            kept, computed = self._orb.compute(padded, keypoints)
            descriptors[rows] = _in_order(kept, computed, len(rows))
        return descriptors


def _in_order(kept: Any, found: np.ndarray, n: int) -> np.ndarray:
    """Return descriptors in the order of the n keypoints, which OpenCV may change."""
    ordered = np.zeros((n, found.shape[1]), found.dtype)
    ordered[[keypoint.class_id for keypoint in kept]] = found
    return ordered


DESCRIBERS: dict[str, type[USurf | Sift | Orb]] = {"usurf": USurf, "sift": Sift, "orb": Orb}


def descriptor_bytes(name: str) -> int:
    """Return the memory of a descriptor as a vector of a log (see `mapfusion.descriptors`).

    Descriptors of other packages count as the longest of ours: nothing of them is run to know it.
    """
    known = [DESCRIBERS[name]] if name in DESCRIBERS else DESCRIBERS.values()
    return max(each.length for each in known) * np.dtype(np.float32).itemsize


def target_of(name: str) -> str:
    """Return `module:class` or `FILE.py:CLASS` of a descriptor; built-in names take precedence.

    Raises:
        ValueError: the name is unknown, or there is no such file.
    """
    if name in DESCRIBERS:
        return f"{__name__}:{DESCRIBERS[name].__name__}"
    if in_file := target_in_file(name, "a descriptor"):
        return in_file
    offered = {entry.name: entry.value for entry in entry_points(group=GROUP)}
    if name not in offered:
        known = [*DESCRIBERS, *offered]
        there = f"known are {', '.join(known)}{did_you_mean(name, known)}"
        raise ValueError(f"unknown descriptor {name!r}, {there}")
    return offered[name]


class NamedDescriber:
    """Descriptor by name, whose answers are checked.

    Raises:
        ValueError: the name is unknown.
        InputError: a plug-in cannot be made.
    """

    def __init__(self, name: str) -> None:
        self._name, own = name, IN_FILE.fullmatch(name)
        self._method = own[2] if own else name  # in files: the folder does not matter
        target = target_of(name)
        try:
            made = load_class(target)()
            require_metric(made.metric)
        except Exception as error:
            told = f"{error}{moved_module_note(error)}"
            raise InputError(f"descriptor {name}: {target} cannot be made: {told}") from error
        self._made: Describer = made

    def describe(
        self, image: np.ndarray, uv_px: Float, scale_px: Float
    ) -> tuple[np.ndarray, DescriptorKind]:
        """Return the descriptors of corners as vectors (N, D), and their kind.

        Raises:
            InputError: a plug-in raised, or gave no finite descriptor for each corner.
        """
        n, name, metric = len(uv_px), self._name, self._made.metric
        try:
            descriptors = self._made.describe(image, uv_px, scale_px)
        except Exception as error:
            if name in DESCRIBERS:  # an error of our own
                raise
            message = one_line(f"{type(error).__name__}: {error}")
            raise InputError(f"descriptor {name}: raised {message}") from error
        if name == USURF.name:
            return descriptors, USURF
        packed, number = metric == "hamming", "uint8" if metric == "hamming" else "float32"
        is_array = (
            isinstance(descriptors, np.ndarray) and descriptors.ndim == 2 and len(descriptors) == n
        )
        if not is_array or descriptors.shape[1] < 1 or descriptors.dtype != number:
            got = (
                f"{descriptors.dtype} {descriptors.shape}"
                if isinstance(descriptors, np.ndarray)
                else type(descriptors)
            )
            raise InputError(f"descriptor {name}: gave {got}, expected {number} ({n}, D)")
        kind = DescriptorKind(metric, descriptors.shape[1] * (8 if packed else 1), self._method)
        if not np.all(np.isfinite(descriptors)):
            raise InputError(f"descriptor {name}: gave a number that is not finite")
        try:
            vectors, kind = as_vectors(descriptors, kind)
        except ValueError as error:
            raise InputError(f"descriptor {name}: {error}") from error
        return vectors, kind
