"""The landmarks of corresponding pairs side by side."""

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mapfusion.align.correspondences import FEW, Correspondences, HeightGate, scale_note
from mapfusion.align.mahalanobis_gate import PlanarPairs
from mapfusion.align.result import Alignment, degenerate
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

MIN_PAIRS = 3  # two determine a motion, the third is the first that can contradict it


@dataclass(frozen=True)
class Pairs:
    """N pairs of landmarks, looked up in their maps.

    Raises:
        ValueError: an index lies outside its map.
    """

    map_a: LandmarkMap
    map_b: LandmarkMap
    correspondences: Correspondences

    def __post_init__(self) -> None:
        for name, index, landmarks in (
            ("index_a", self.index_a, self.map_a),
            ("index_b", self.index_b, self.map_b),
        ):
            if len(index) and not 0 <= index.min() <= index.max() < len(landmarks):
                raise ValueError(f"{name}: must lie in 0..{len(landmarks) - 1}")

    def __len__(self) -> int:
        return len(self.correspondences)

    def __getitem__(self, rows: np.ndarray) -> "Pairs":
        return Pairs(self.map_a, self.map_b, self.correspondences[rows])

    @cached_property
    def kept(self) -> dict[type, Any]:
        """What methods keep of the maps between their calls with these pairs, each by its type."""
        return {}

    @property
    def index_a(self) -> np.ndarray:
        """(N,) rows of map a."""
        return self.correspondences.index_a

    @property
    def index_b(self) -> np.ndarray:
        """(N,) rows of map b."""
        return self.correspondences.index_b

    @property
    def distance(self) -> Float:
        """(N,) of the descriptors, 0 for pairs made by label."""
        return self.correspondences.distance

    @property
    def planar(self) -> bool:
        """Whether heights carry no information."""
        return self.map_a.planar or self.map_b.planar

    @property
    def by_name(self) -> bool:
        """Whether both maps carry labels, by which landmarks are then paired."""
        return self.map_a.label is not None and self.map_b.label is not None

    @cached_property
    def p_a(self) -> Float:
        """(N, 3) positions in metres, in frame a."""
        return self.map_a.position_m.take(self.index_a, axis=0)

    @cached_property
    def p_b(self) -> Float:
        """(N, 3) positions in metres, in frame b."""
        return self.map_b.position_m.take(self.index_b, axis=0)

    @cached_property
    def covariance_a(self) -> Float:
        """(N, 3, 3) in frame a."""
        return self.map_a.covariance_m2.take(self.index_a, axis=0)

    @cached_property
    def covariance_b(self) -> Float:
        """(N, 3, 3) in frame b."""
        return self.map_b.covariance_m2.take(self.index_b, axis=0)

    @cached_property
    def scale_note(self) -> str:
        """By what factor one map is larger than the other, in words; empty if by none."""
        return scale_note(self.map_a, self.map_b, self.index_a, self.index_b) if len(self) else ""

    def note(self, n_support: int) -> str:
        """Return what about the maps explains that no motion is accepted; empty for nothing.

        `n_support` is how many pairs support the motion found.
        """
        if self.by_name and not self.scale_note and FEW <= len(self) > 2 * n_support:
            return f"{len(self)} labels are in both maps: do they name the same landmarks?"
        return self.scale_note

    def points(self) -> tuple[Float, Float]:
        """Positions (N, 3) in both frames, (N, 2) where heights carry no information."""
        dimensions = 2 if self.planar else 3
        return (
            np.ascontiguousarray(self.p_a[:, :dimensions]),
            np.ascontiguousarray(self.p_b[:, :dimensions]),
        )

    def in_plan(self) -> PlanarPairs:
        """The pairs without their heights, for the kernels, which do not change them."""
        return self._plan

    @cached_property
    def _plan(self) -> PlanarPairs:
        n = len(self)
        plan = PlanarPairs(*np.empty((2, n, 2)), *np.empty((2, n, 2, 2)))
        for part, whole in zip(plan[:2], (self.p_a, self.p_b), strict=True):
            part[:, 0], part[:, 1] = whole[:, 0], whole[:, 1]
        for part, whole in zip(plan[2:], (self.covariance_a, self.covariance_b), strict=True):
            part[:, 0, 0], part[:, 0, 1] = whole[:, 0, 0], whole[:, 0, 1]
            part[:, 1, 0], part[:, 1, 1] = whole[:, 1, 0], whole[:, 1, 1]
        return plan

    def of_one_height(self, gate: HeightGate) -> np.ndarray:
        """Rows (n,) of the pairs whose heights agree; of planar maps all."""
        if self.planar:
            return np.arange(len(self))
        return np.flatnonzero(
            gate.agrees(
                self.p_a[:, 2],
                self.covariance_a[:, 2, 2],
                self.p_b[:, 2],
                self.covariance_b[:, 2, 2],
            )
        )


def why_too_few(
    map_a: LandmarkMap, map_b: LandmarkMap, n_pairs: int, needed: int, shortage: str = ""
) -> str:
    """Return why there are fewer than `needed` pairs; empty when there are enough.

    `shortage` is that of the correspondences, which names the test that left so few.
    """
    if n_pairs >= needed:
        return ""
    for landmarks in (map_a, map_b):
        if len(landmarks) == 0:
            return f"map {landmarks.name} is empty"
    if n_pairs == 0 and not shortage:
        for landmarks in (map_a, map_b):
            if landmarks.descriptor is None and landmarks.label is None:
                return f"map {landmarks.name} has neither descriptors nor labels to match by"
    few = f"{n_pairs} correspondences, at least {needed} are needed"
    return f"{few}: {shortage}" if shortage else few


def undetermined(reason: str, n_pairs: int, started_s: float) -> Alignment:
    """A degenerate result with its elapsed time since `time.perf_counter()` was started_s."""
    return degenerate(reason, n_pairs, time.perf_counter() - started_s)


gather = Pairs  # by this name packages with the interface `align` import it
