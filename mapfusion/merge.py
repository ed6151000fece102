"""Merging aligned maps into one (eq. 12 to 16, corrected)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.result import Alignment
from mapfusion.aligned_landmarks import AlignedLandmarks
from mapfusion.arguments import Probability, Range, require_in_range, require_shape
from mapfusion.landmark_map import LandmarkMap
from mapfusion.same_point import SamePoint, one_to_one
from mapfusion.se2 import IDENTITY, Float


@dataclass(frozen=True)
class MergeParameters:
    """How maps are merged.

    Attributes:
        max_descriptor_distance: of landmarks that the second pass takes for one point; with labels
            on both sides these decide instead.
        gate_probability: of keeping two landmarks of one point in the second pass (chi-square, 2
            degrees of freedom, drift included).
        height: which landmarks of the second pass can have one height (not for planar maps).
        use_drift: weigh with, and report, S + s_drift^2 I instead of the paper's S. An alignment's
            s_drift^2 belongs to two maps and is given half to each; the first map, which is in all
            alignments, gets the mean of its halves.
        use_alignment_uncertainty: add J S_T J^T, the alignment's own covariance to first order, to
            the landmarks it moves. The paper does not. This error is common to all of them, which
            per-landmark covariances cannot say.
    """

    max_descriptor_distance: Annotated[float, Range(1e-3, 2, "1")] = 0.3
    gate_probability: Probability = 0.99
    height: HeightGate = field(default_factory=HeightGate)
    use_drift: bool = True
    use_alignment_uncertainty: bool = False

    def __post_init__(self) -> None:
        require_in_range(self)


@dataclass(frozen=True)
class FusedMap:
    """N landmarks fused from M maps, in the frame of the first.

    Attributes:
        landmarks: the fused map.
        parents: (N, M) row of each map that went into each landmark, ABSENT for none.
        T_first_map: (M, 3) motion of each map into the fused frame; NaN for maps left out.
        drift_sigma_m: (M,) share of each map in s_drift; NaN for maps left out.
        duplicate_share: share of the landmarks that another one still passes for, by the gate and
            descriptor test of the second pass.
        left_out: name of each map whose alignment was not accepted, with the reason.
    """

    landmarks: LandmarkMap
    parents: np.ndarray
    T_first_map: Float
    drift_sigma_m: Float
    duplicate_share: float
    left_out: tuple[tuple[str, str], ...]


def merge(
    maps: Sequence[LandmarkMap],
    alignments: Sequence[Alignment],
    correspondences: Sequence[Correspondences],
    parameters: MergeParameters = MergeParameters(),
) -> FusedMap:
    """Fuse two or more maps in the frame of the first.

    Each further map's refined inliers are fused with the first map's landmarks; then what these
    missed is paired with any fused landmark by gate and descriptor; the rest is carried over.

    Args:
        maps: M of them.
        alignments: M - 1 refined ones, T_first_map of maps[1:]. Maps whose alignment was not
            accepted are left out.
        correspondences: M - 1, between the first map (a) and each other (b), as they were aligned.
        parameters: how to merge.

    Raises:
        ValueError: lengths that do not fit, or fewer than two maps.
    """
    _require_fitting(maps, alignments, correspondences)
    kept = [k for k, alignment in enumerate(alignments, start=1) if alignment.ok]
    T_first_map, drift = _motions(alignments, kept)
    planar = any(landmarks.planar for landmarks in maps)
    test = SamePoint(
        parameters.max_descriptor_distance, parameters.gate_probability, parameters.height, planar
    )

    fused = AlignedLandmarks.of(maps, 0, T_first_map[0], None, drift[0], parameters.use_drift)
    for k in kept:
        alignment, pairs = alignments[k - 1], correspondences[k - 1]
        sigma_T = alignment.covariance if parameters.use_alignment_uncertainty else None
        other = AlignedLandmarks.of(
            maps, k, T_first_map[k], sigma_T, drift[k], parameters.use_drift
        )
        rows, others = _paired(fused, other, pairs[alignment.inlier], test)
        fused = fused.joined(other, rows, others, 2 if planar else 3)

    first, second, _ = test.candidates(fused, fused)
    duplicates = np.unique(first[first != second])
    left_out = tuple(
        (maps[k].name, alignment.reason)
        for k, alignment in enumerate(alignments, start=1)
        if not alignment.ok
    )
    return FusedMap(
        fused.landmark_map(planar, maps[0].name),
        fused.parents,
        T_first_map,
        drift,
        len(duplicates) / max(len(fused), 1),
        left_out,
    )


def _motions(alignments: Sequence[Alignment], kept: Sequence[int]) -> tuple[Float, Float]:
    """T_first_map (M, 3) and s_drift (M,) of each map; NaN for those that are left out."""
    T_first_map = np.full((len(alignments) + 1, 3), np.nan)
    T_first_map[0] = IDENTITY
    drift = np.full(len(alignments) + 1, np.nan)
    for k in kept:
        T_first_map[k] = alignments[k - 1].T_a_b
        drift[k] = alignments[k - 1].drift_sigma_m / np.sqrt(2)
    drift[0] = np.sqrt(np.mean(drift[kept] ** 2)) if kept else 0.0
    return T_first_map, drift


def _paired(
    fused: AlignedLandmarks, other: AlignedLandmarks, inliers: Correspondences, test: SamePoint
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the fused and of the other map that are one: the inliers, then what they missed."""
    # the first map's landmarks are the first rows of the fused map, in their order
    rows, others = inliers.index_a, inliers.index_b
    missed_rows = np.setdiff1d(np.arange(len(fused)), rows)
    missed_others = np.setdiff1d(np.arange(len(other)), others)
    more_rows, more_others = one_to_one(*test.candidates(fused[missed_rows], other[missed_others]))
    return (
        np.concatenate([rows, missed_rows[more_rows]]),
        np.concatenate([others, missed_others[more_others]]),
    )


def _require_fitting(
    maps: Sequence[LandmarkMap],
    alignments: Sequence[Alignment],
    correspondences: Sequence[Correspondences],
) -> None:
    if len(maps) < 2:
        raise ValueError(f"maps: {len(maps)} given, at least 2 are needed")
    for name, values in (("alignments", alignments), ("correspondences", correspondences)):
        if len(values) != len(maps) - 1:
            raise ValueError(f"{name}: {len(values)} given, expected {len(maps) - 1}")
    for k, (alignment, pairs) in enumerate(zip(alignments, correspondences, strict=True)):
        require_shape(f"alignments[{k}].inlier", alignment.inlier, (len(pairs),))
        for name, index, landmarks in (
            ("index_a", pairs.index_a[alignment.inlier], maps[0]),
            ("index_b", pairs.index_b[alignment.inlier], maps[k + 1]),
        ):
            if len(np.unique(index)) < len(index):
                raise ValueError(f"correspondences[{k}].{name}: inliers are not one to one")
            if len(index) and not 0 <= index.min() <= index.max() < len(landmarks):
                raise ValueError(f"correspondences[{k}].{name}: lies outside its map")
