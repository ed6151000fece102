"""Kinds of landmark descriptors: metric, length and unit of distance.

In memory, a descriptor is a vector of floats, and NaN stands for none. The Euclidean distance of
two vectors is a function of the metric of their kind:

- `euclidean`: the vectors are the descriptors, and so is the distance.
- `cosine`: the vectors have norm 1. Their squared distance is 2 - 2 c, with the cosine c of the
  angle between the descriptors.
- `hamming`: the elements are bits, 0 or 1. The squared distance is the number of different bits.

The distance of two descriptors is the Euclidean one, and of `hamming` the number of different bits.
Thresholds are chosen for U-SURF (the paper's descriptor), whose vectors have norm 1; two different
landmarks have a median distance of 0.8. Distances of other kinds are divided by a reference, so
that their median distance is 0.8, too. The reference follows from the data alone.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from mapfusion.errors import InputError, did_you_mean

Metric = Literal["euclidean", "cosine", "hamming"]
METRICS: tuple[Metric, ...] = get_args(Metric)
# A longer descriptor is a mistake, such as an image: learned descriptors have up to 4096 numbers.
MAX_LENGTH = 65_536
# Vectors whose norms lie within this factor of 1 are unit vectors: their numbers may be rounded.
_NORM_FACTOR = 2.0
_UNIT_TOLERANCE = 1e-3  # error of a norm after rounding to single precision, with a margin
# The median distance is that of all pairs of at most this many descriptors: its standard error is
# then below 1 %, and the time is a millisecond.
_MOST_COMPARED = 384
# Median distance of the U-SURF descriptors of two different landmarks of a map.
USURF_MEDIAN = 0.8
# Ratio of the references of two maps from which on their numbers have different units. Maps of one
# method differ by a few percent.
_OTHER_UNIT = 4.0
_ONE_METHOD = "compute both by one method, or remove the descriptors of one map"
_METRIC, _NAME, _REFERENCE = "descriptor_metric", "descriptor_name", "descriptor_reference"


def require_metric(metric: str) -> None:
    """Raise ValueError unless the metric is known."""
    if metric not in METRICS:
        known = f"known are {', '.join(METRICS)}{did_you_mean(metric, METRICS)}"
        raise ValueError(f"descriptor_metric: is {metric!r}, {known}")


@dataclass(frozen=True)
class DescriptorKind:
    """Kind of descriptors. Descriptors of different kinds cannot be compared.

    Attributes:
        metric: `euclidean`, `cosine` or `hamming`.
        length: number of elements of a vector; bits of `hamming`.
        name: name of the method that computed them; empty if unknown.
        reference: distance of two descriptors that counts as 1. None: it follows from the median
            distance of the descriptors it is used for.
    """

    metric: Metric
    length: int
    name: str = ""
    reference: float | None = None

    def __post_init__(self) -> None:
        require_metric(self.metric)
        if not 1 <= self.length <= MAX_LENGTH:
            raise ValueError(f"length: is {self.length}, expected 1 to {MAX_LENGTH}")
        if self.reference is not None and not 0 < self.reference < math.inf:
            raise ValueError(f"reference: is {self.reference}, expected a positive number")

    def __str__(self) -> str:
        elements = "bits" if self.metric == "hamming" else "numbers"
        name = f" ({self.name})" if self.name else ""
        return f"{self.metric}, {self.length} {elements}{name}"

    @property
    def _power(self) -> int:
        """Power of the vectors' Euclidean distance that is the distance of the descriptors."""
        return 2 if self.metric == "hamming" else 1

    def may_be_bits_of(self, other: "DescriptorKind") -> bool:
        """Return True if these numbers may be the packed bits of another kind."""
        is_other = self.metric == "euclidean" and other.metric == "hamming"
        return is_other and not self.name and 8 * self.length == other.length

    def differs_from(self, other: "DescriptorKind") -> bool:
        """Return True if descriptors of both kinds cannot be compared.

        A kind without a name is that of any name with the same metric and length.
        """
        if self.name and other.name and self.name != other.name:
            return True
        return (self.metric, self.length) != (other.metric, other.length)

    def on(self, vectors: np.ndarray) -> "DescriptorKind":
        """Return the kind with a reference, by default that of vectors (N, length)."""
        if self.reference is not None:
            return self
        median = median_distance(vectors)
        if median is None:
            return self
        return replace(self, reference=median**self._power / USURF_MEDIAN)

    def attributes(self) -> dict[str, str]:
        """Return the kind as text attributes of a table; the inverse of `kind_from`."""
        stated = {} if self.reference is None else {_REFERENCE: repr(float(self.reference))}
        return {_METRIC: self.metric, _NAME: self.name} | stated


USURF = DescriptorKind("euclidean", 64, "usurf", 1.0)


def kind_from(attributes: Mapping[str, str], length: int) -> DescriptorKind | None:
    """Return the kind that a table states for vectors of a length; None if it states none.

    Raises:
        ValueError: the kind is not as documented.
    """
    if _METRIC not in attributes:
        return None
    stated = attributes.get(_REFERENCE)
    reference = None if stated is None else float(stated)
    metric: Metric = attributes[_METRIC]  # type: ignore[assignment]  # the constructor checks it
    return DescriptorKind(metric, length, attributes.get(_NAME, ""), reference)


def stated_metric(attributes: Mapping[str, str]) -> str:
    """Return the metric that a table states; empty if it states none."""
    return attributes.get(_METRIC, "")


def guessed_kind(vectors: np.ndarray) -> DescriptorKind:
    """Return the kind of vectors (N, D) of which only the numbers are known.

    It is U-SURF for 64 numbers of norm 1, or 0 where a window is flat; else `euclidean`.
    """
    if vectors.shape[1] == USURF.length:
        norms = np.linalg.norm(vectors, axis=1)
        norms = norms[norms > 0]  # not NaN
        if np.all((norms > 1 / _NORM_FACTOR) & (norms < _NORM_FACTOR)):
            return USURF
    return DescriptorKind("euclidean", vectors.shape[1])


def as_vectors(
    descriptor: np.ndarray, kind: DescriptorKind | None
) -> tuple[np.ndarray, DescriptorKind]:
    """Return descriptors (N, length) as vectors, and their kind with its reference.

    Args:
        descriptor: vectors (N, length); or packed bits (N, length / 8) uint8.
        kind: their kind; None: `hamming` for packed bits, else `guessed_kind`.

    Raises:
        ValueError: the descriptors are not of the kind, or one of `cosine` is zero.
    """
    packed = descriptor.dtype == np.uint8
    bits = packed and (kind is None or kind.metric == "hamming")
    vectors = unpack_bits(descriptor) if bits else descriptor
    if kind is None:
        kind = DescriptorKind("hamming", vectors.shape[1]) if bits else guessed_kind(vectors)
    if vectors.ndim != 2 or vectors.shape[1] != kind.length:
        raise ValueError(f"descriptor: shape is {descriptor.shape}, expected {kind}")
    if not np.issubdtype(vectors.dtype, np.floating):
        vectors = vectors.astype(np.float32)
    if kind.metric == "cosine":
        norms = np.linalg.norm(vectors, axis=1)
        if np.any(norms == 0):
            row = np.flatnonzero(norms == 0)[0]
            raise ValueError(f"descriptor: row {row} is zero and has no direction; give NaN")
        if np.any(np.abs(norms - 1) > _UNIT_TOLERANCE):
            vectors = vectors / norms[:, None].astype(vectors.dtype)
    return vectors, kind.on(vectors)


def unpack_bits(packed: np.ndarray) -> np.ndarray:
    """Return packed bits (N, B) uint8 as vectors (N, 8 B); the first bit is the highest one."""
    return np.unpackbits(np.ascontiguousarray(packed, np.uint8), axis=1).astype(np.float32)


def pack_bits(vectors: np.ndarray) -> np.ndarray:
    """Return vectors of bits (N, 8 B) as packed bits (N, B) uint8; the inverse of `unpack_bits`.

    A vector of NaN becomes zeros.
    """
    return np.packbits(vectors > 0, axis=1)


def median_distance(vectors: np.ndarray) -> float | None:
    """Return the median Euclidean distance of different vectors (N, D); None if no two differ.

    Of many vectors some are compared, evenly spaced: consecutive ones may be of one landmark.
    """
    known = np.flatnonzero(~np.isnan(vectors).any(axis=1))
    step = max(1, math.ceil(len(known) / _MOST_COMPARED))
    some = vectors[known[::step]].astype(np.float64)
    some -= some.mean(axis=0) if len(some) else 0.0  # distances lose fewer digits
    square = np.einsum("ij,ij->i", some, some)
    first, second = np.triu_indices(len(some), 1)
    apart2 = (square[:, None] + square - 2 * some @ some.T)[first, second]
    # relative to the norms, smaller squares are rounding errors of equal vectors
    apart2 = apart2[apart2 > 1e-12 * (square[first] + square[second])]
    return float(np.sqrt(np.median(apart2))) if len(apart2) else None


def merged_kind(*kinds: DescriptorKind | None) -> DescriptorKind | None:
    """Return the kind of descriptors of several maps; None if none has any.

    Its reference is the geometric mean of theirs.
    """
    stated = [kind for kind in kinds if kind is not None]
    if not stated:
        return None
    named = next((kind for kind in stated if kind.name), stated[0])
    references = [kind.reference for kind in stated if kind.reference]
    mean = float(np.exp(np.mean(np.log(references)))) if references else None
    return replace(named, reference=mean)


def euclidean_distance_at(threshold: float, *kinds: DescriptorKind | None) -> float:
    """Return the Euclidean distance of vectors of some kinds at a threshold of their distance."""
    kind = merged_kind(*kinds)
    if kind is None:
        return threshold
    return (threshold * (kind.reference or 1.0)) ** (1 / kind._power)


def relative_distance(apart: Any, *kinds: DescriptorKind | None) -> Any:
    """Return the distances of vectors of some kinds by their Euclidean distances.

    The inverse of `euclidean_distance_at`.
    """
    kind = merged_kind(*kinds)
    if kind is None:
        return apart
    return apart**kind._power / (kind.reference or 1.0)


def require_one_kind(named: Sequence[tuple[str, DescriptorKind | None]]) -> None:
    """Raise InputError, naming both, if descriptors of two maps differ in kind or in unit.

    Args:
        named: name or file of each map, and the kind of its descriptors; None for none.
    """
    stated = [(name, kind) for name, kind in named if kind is not None]
    for k, (name, kind) in enumerate(stated):
        for before, known in stated[:k]:
            if kind.differs_from(known):
                remedy = _ONE_METHOD
                for floats, bits, of in ((kind, known, name), (known, kind, before)):
                    if floats.may_be_bits_of(bits):
                        remedy = f"if those of {of} are packed bits, which an empty cell turned "
                        remedy += "into floats, give --descriptor-metric hamming, or name the "
                        remedy += "column descriptor_hamming; else " + _ONE_METHOD
                raise InputError(
                    f"{name} has descriptors of another kind ({kind}) than {before} ({known}); "
                    f"{remedy}"
                )
            ratio = (kind.reference or 1.0) / (known.reference or 1.0)
            if kind.reference and known.reference and not 1 / _OTHER_UNIT < ratio < _OTHER_UNIT:
                raise InputError(
                    f"descriptors of {name} are {ratio:.2g} times as far apart as those of "
                    f"{before}: scale both alike"
                )
