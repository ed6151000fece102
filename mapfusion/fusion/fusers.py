"""Interface of fusers: aligned maps, parameters and the fused map; fusers by name.

A package provides a fuser by an entry point of the group `mapfusion.fusers`: its name and a class
that implements `Fuser` and has a constructor without arguments.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from itertools import zip_longest
from typing import Annotated, Any, Protocol

import numpy as np

from mapfusion.align.alignment import Alignment
from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.errors import did_you_mean, moved_module_note
from mapfusion.fusion.landmark_association import AssociationTest
from mapfusion.fusion.team_graph import EdgeStatus, TeamParameters
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import Probability, Range, require_in_range
from mapfusion.plugin_classes import load_class
from mapfusion.smoother.smooth import AssociatedLog


@dataclass(frozen=True)
class AlignedPair:
    """Alignment of two of the maps that are merged.

    Attributes:
        a: index of the reference map.
        b: index of the other map.
        alignment: refined alignment T_a_b; not used if it was rejected.
        correspondences: correspondences that the alignment was computed from.
        log10_false_alarms: logarithm of the expected number of false alarms. Of contradictory
            alignments without other confirmation the one with the lowest number is used.
    """

    a: int
    b: int
    alignment: Alignment
    correspondences: Correspondences
    log10_false_alarms: float = 0.0

    @property
    def inliers(self) -> Correspondences:
        """Correspondences that are inliers of the alignment."""
        return self.correspondences[self.alignment.inlier]


@dataclass(frozen=True)
class FusedMap:
    """N landmarks fused from some of M maps, in the frame of the first of these.

    Attributes:
        landmarks: the fused map.
        parents: row of each landmark in each map, shape (N, M); ABSENT for none.
        T_first_map: pose of each map in the fused frame, shape (M, 3); NaN for maps left out.
        motion_covariance: covariances of these poses, shape (M, 3, 3); zero for the first, NaN for
            maps left out.
        drift_sigma_m: s_drift of each map that was added, shape (M,); NaN for maps left out.
        duplicate_share: share of the landmarks that pass the gate and descriptor test with another
            landmark.
        left_out: name of each map that was not fused, with the reason.
        fallback: reason for the use of a simpler fuser than the requested one, or a defect of the
            fused covariances; empty if none.
        paths: path of each member in the fused frame, shape (T_k, 3); empty if the fuser does not
            estimate paths.
        middle_covariance: covariances of the poses at the middle of each map, shape (M, 3, 3); None
            if they were not computed (`merge` does).
        height_m: height of each map's origin in the fused frame, shape (M,); None as above.
    """

    landmarks: LandmarkMap
    parents: np.ndarray
    T_first_map: Float
    motion_covariance: Float
    drift_sigma_m: Float
    duplicate_share: float
    left_out: tuple[tuple[str, str], ...]
    fallback: str = ""
    paths: tuple[Float, ...] = ()
    middle_covariance: Float | None = None
    height_m: Float | None = None

    @property
    def stated_covariance(self) -> Float:
        """Covariances (M, 3, 3) at the middles of the maps, or at their origins if unknown."""
        return self.motion_covariance if self.middle_covariance is None else self.middle_covariance

    @property
    def members(self) -> np.ndarray:
        """Indices of the fused maps; the first map defines the frame."""
        return np.flatnonzero(np.isfinite(self.T_first_map[:, 0]))


@dataclass(frozen=True)
class Fusion:
    """Result of a merge.

    Attributes:
        fused: a fused map for each set of connected maps, largest set first. Unconnected maps are
            not included; if no maps are connected, only the first map is.
        edge_status: status of the alignment of each pair.
    """

    fused: tuple[FusedMap, ...]
    edge_status: tuple[EdgeStatus, ...]


_DIGITS = re.compile("([0-9]+)")


def name_order(name: str) -> tuple[list[Any], str]:
    """Return a natural sorting key: R2 is before R10."""
    parts = _DIGITS.split(name)  # alternating words and numbers
    numbers = [(len(digits), digits) for digits in (part.lstrip("0") for part in parts[1::2])]
    return [
        key
        for text_and_number in zip_longest(parts[::2], numbers)
        for key in text_and_number
        if key is not None
    ], name


@dataclass(frozen=True)
class MergeParameters:
    """Parameters of a merge.

    Attributes:
        team: selection of consistent alignments between more than two maps.
        max_descriptor_distance: largest descriptor distance of landmarks that are associated
            without an alignment, 0.8 is the median of different landmarks; not used if both have
            labels.
        gate_probability: probability that landmarks of the same point pass the gate (chi-square, 2
            degrees of freedom, drift included; joint fusion: fitted Student-t distribution).
        height: test of the heights; not used for planar maps and joint covariances.
        use_alignment_uncertainty: add J S_T J^T, the first-order covariance of the map's pose, to
            the landmarks that the Kalman fusers transform. The paper does not add it. The error is
            common to all landmarks of a map, so separate covariances overstate it; and the result
            depends on the order of the maps.
    """

    team: TeamParameters = field(default_factory=TeamParameters)
    max_descriptor_distance: Annotated[float, Range(1e-3, 2, "1")] = 0.3
    gate_probability: Probability = 0.99
    height: HeightGate = field(default_factory=HeightGate)
    use_alignment_uncertainty: bool = False

    def __post_init__(self) -> None:
        require_in_range(self)

    def association_test(self, planar: bool) -> AssociationTest:
        """Return the test for landmarks that are no inliers of an alignment."""
        return AssociationTest(
            self.max_descriptor_distance, self.gate_probability, self.height, planar
        )


_MEDIAN_OVER_SIGMA = 0.6745  # median absolute value of a standard normal variable


@dataclass(frozen=True)
class Component:
    """Connected component: K of M maps with their poses in a common frame.

    Attributes:
        maps: all M maps.
        members: indices of the maps that are fused, shape (K,); the first defines the frame.
        pairs: alignments between members that are used.
        T_first_map: pose of each member in the fused frame, shape (M, 3); NaN for the others.
        motion_covariance: covariances of these poses, shape (M, 3, 3).
        left_out: name of each other map, with the reason.
        recordings: log that each map was smoothed from; empty or None if unknown.
    """

    maps: tuple[LandmarkMap, ...]
    members: np.ndarray
    pairs: tuple[AlignedPair, ...]
    T_first_map: Float
    motion_covariance: Float
    left_out: tuple[tuple[str, str], ...]
    recordings: tuple[AssociatedLog | None, ...] = ()

    @property
    def by_name(self) -> list[int]:
        """Members in the order of their names, which does not depend on the frame."""
        return sorted(self.members.tolist(), key=lambda k: name_order(self.maps[k].name))

    @property
    def planar(self) -> bool:
        """True if heights carry no information."""
        return any(self.maps[k].planar for k in self.members)

    @property
    def drift_sigma_m(self) -> Float:
        """Standard deviation s_drift of each map, shape (M,); NaN for maps left out.

        Half of an alignment's s_drift^2 is attributed to each of its maps. A map has the mean over
        its alignments.
        """
        return self._by_map([pair.alignment.drift_sigma_m for pair in self.pairs])

    @property
    def height_sigma_m(self) -> Float:
        """Standard deviation of heights beyond the stated variances, as `drift_sigma_m`.

        It is estimated by the median absolute height difference of the inliers.
        """
        sigma_m = []
        for pair in self.pairs:
            a, b = (self.maps[k] for k in (pair.a, pair.b))
            rows_a, rows_b = pair.inliers.index_a, pair.inliers.index_b
            off_m = np.abs(a.position_m[rows_a, 2] - b.position_m[rows_b, 2])
            stated_m2 = a.covariance_m2[rows_a, 2, 2] + b.covariance_m2[rows_b, 2, 2]
            seen_m2 = (np.median(off_m) / _MEDIAN_OVER_SIGMA) ** 2 if len(off_m) else 0.0
            beyond_m2 = seen_m2 - np.median(stated_m2) if len(off_m) else 0.0
            sigma_m.append(float(np.sqrt(max(beyond_m2, 0.0))))
        return self._by_map(sigma_m)

    def _by_map(self, sigma_m: Sequence[float]) -> Float:
        """Return the standard deviation of each map, shape (M,), from those of the pairs."""
        of_maps = np.full(len(self.maps), np.nan)
        for k in self.members:
            pairs = zip(self.pairs, sigma_m, strict=True)
            map_sigmas = [sigma for pair, sigma in pairs if k in (pair.a, pair.b)]
            of_maps[k] = np.sqrt(np.mean(np.square(map_sigmas)) / 2) if map_sigmas else 0.0
        return of_maps


class Fuser(Protocol):
    """Interface of fusers, which fuse the maps of a connected component.

    The constructor has no arguments. Landmarks that cannot be fused are kept; `fuse` raises no
    errors.

    Attributes:
        smoothed: true if the fuser uses the smoother's maps if there are any; false if it uses the
            filter's maps.
    """

    smoothed: bool

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the maps of a component."""
        ...


GROUP = "mapfusion.fusers"
FUSERS = {
    "kalman": "mapfusion.fusion.kalman:Kalman",
    "kalman-drift": "mapfusion.fusion.kalman:KalmanDrift",
    "kalman_as_printed": "mapfusion.fusion.kalman:KalmanAsPrinted",
    "covariance_intersection": "mapfusion.fusion.covariance_intersection:CovarianceIntersection",
    "joint": "mapfusion.fusion.joint:JointFuser",
    "batch": "mapfusion.fusion.batch:Batch",
}
# Reference that smooths all logs jointly, which is much slower than the other fusers.
REFERENCE = "batch"
# The paper's fuser with the wrong sign of eq. 13.
AS_PRINTED = "kalman_as_printed"
# Fusers of scenarios that name none.
COMPARED = tuple(name for name in FUSERS if name not in (REFERENCE, AS_PRINTED))
USUAL = "joint"  # default fuser


def target_of(name: str) -> str:
    """Return `module:class` of a fuser; built-in names take precedence.

    Raises:
        ValueError: the name is unknown.
    """
    if name in FUSERS:
        return FUSERS[name]
    offered = {entry.name: entry.value for entry in entry_points(group=GROUP)}
    if name not in offered:
        known_names = [*FUSERS, *offered]
        known_text = f"known are {', '.join(known_names)}{did_you_mean(name, known_names)}"
        raise ValueError(f"unknown fuser {name!r}, {known_text}")
    return offered[name]


def make_fuser(name: str = USUAL) -> Fuser:
    """Return the fuser with this name.

    Raises:
        ValueError: the name is unknown, or a plug-in cannot be used.
    """
    target = target_of(name)
    try:
        fuser = load_class(target)()
    except Exception as error:
        message = f"{error}{moved_module_note(error)}"
        raise ValueError(f"fuser {name}: {target} cannot be made: {message}") from error
    for attribute in ("fuse", "smoothed"):
        if not hasattr(fuser, attribute):
            raise ValueError(f"fuser {name}: {target} has no {attribute}")
    return fuser
