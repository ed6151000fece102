"""Adapters for aligners of other packages: OpenCV's RANSAC, KISS-Matcher (extra `[peers]`).

OpenCV: `estimateAffinePartial2D`, RANSAC for planar similarities. KISS-Matcher (Lim et al. 2024):
pruning by pairwise consistency, then graduated non-convexity for yaw and shift.
"""

import importlib
import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from mapfusion.align.alignment import Fit, Pairs, Undetermined, supported
from mapfusion.geometry.se2 import rotation, transform_points
from mapfusion.parameters import Probability, Range, require_in_range


@dataclass(frozen=True)
class OpenCv:
    """`cv2.estimateAffinePartial2D` on the landmarks in plan.

    OpenCV fits a similarity with a scale, which the maps do not have. theta is the angle of the
    nearest rotation, and the translation is solved again for theta on OpenCV's supporters. Only
    supporters within the gate under this motion are kept. Heights are not used.

    Attributes:
        gate_m: `ransacReprojThreshold`, as in `Ransac`.
        confidence: `confidence`.
        max_draws: `maxIters`.
        local_rounds: `refineIters`, Levenberg-Marquardt steps (default of OpenCV).
    """

    randomised: ClassVar[bool] = True
    gate_m: Annotated[float, Range(1e-3, 1000, "m")] = 0.3
    confidence: Probability = 0.9999
    max_draws: Annotated[int, Range(1, 100_000_000, "draws")] = 20_000
    local_rounds: Annotated[int, Range(0, 100_000, "rounds")] = 10

    def __post_init__(self) -> None:
        require_in_range(self)

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """Estimate T_a_b from the similarity, without its scale.

        OpenCV's RANSAC draws the same rows in every call and ignores `cv2.setRNGSeed` (OpenCV issue
        24835, intended). The pairs are therefore permuted by `rng`.
        """
        import cv2

        order = rng.permutation(len(pairs))
        p_a, p_b = (np.ascontiguousarray(p[order, :2]) for p in (pairs.p_a, pairs.p_b))
        similarity, supports = cv2.estimateAffinePartial2D(
            p_b,
            p_a,
            method=cv2.RANSAC,
            ransacReprojThreshold=self.gate_m,
            maxIters=self.max_draws,
            confidence=self.confidence,
            refineIters=self.local_rounds,
        )
        supporter = np.zeros(len(pairs), dtype=bool) if supports is None else supports.ravel() != 0
        if similarity is None or not np.isfinite(similarity).all() or not supporter.any():
            return Undetermined("OpenCV found no similarity")
        theta = math.atan2(similarity[1, 0], similarity[0, 0])
        t = p_a[supporter].mean(axis=0) - rotation(theta) @ p_b[supporter].mean(axis=0)
        T_a_b = np.array([*t, theta])
        within = np.linalg.norm(p_a - transform_points(T_a_b, p_b), axis=1) <= self.gate_m
        inlier = np.zeros(len(pairs), dtype=bool)
        inlier[order] = supporter & within
        return supported(pairs, inlier, T_a_b)


_SMALLEST_BOUND_M = 5e-3  # the package rejects smaller values


@dataclass(frozen=True)
class KissMatcher:
    """`KISSMatcher.prune_and_solve` on given correspondences, rotation about the height axis only.

    The correspondences are pruned to the maximum core of the graph of pairwise consistent ones
    (ROBIN) and solved by graduated non-convexity (yaw-only rotation of Quatro, translation per
    axis). Features and matching of the package are not used. The package does not name the
    correspondences that it kept; the supporters are the pairs within the bound.

    The rotation solver of the package keeps its first noise bound for the life of the process;
    isolated processes therefore serve one set of parameters each.

    Attributes:
        noise_bound_m: largest residual of a true pair (`voxel_size` with `robin_noise_bound_gain`
            1), like the gate of RANSAC.
        solver_share: noise bound of the solver relative to `noise_bound_m`
            (`solver_noise_bound_gain`, default of the package).
    """

    randomised: ClassVar[bool] = False
    noise_bound_m: Annotated[float, Range(_SMALLEST_BOUND_M, 1000, "m")] = 0.3
    solver_share: Annotated[float, Range(1e-3, 1, "1")] = 0.75

    def __post_init__(self) -> None:
        require_in_range(self)

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """Estimate T_a_b; `rng` is not used."""
        package: Any = importlib.import_module("kiss_matcher")  # without type stubs

        del rng
        config = package.KISSMatcherConfig(
            voxel_size=self.noise_bound_m,
            use_voxel_sampling=False,
            use_quatro=True,
            robin_noise_bound_gain=1.0,
            solver_noise_bound_gain=self.solver_share,
        )
        p_a, p_b = (list(p.astype(np.float32)) for p in (pairs.p_a, pairs.p_b))
        solution = package.KISSMatcher(config).prune_and_solve(p_b, p_a)
        if not solution.valid:
            return Undetermined("KISS-Matcher found no correspondences that agree")
        R, t = np.asarray(solution.rotation), np.asarray(solution.translation).ravel()
        T_a_b = np.array([t[0], t[1], math.atan2(R[1, 0], R[0, 0])])
        if not np.isfinite(T_a_b).all():
            return Undetermined("KISS-Matcher found no motion")
        dimensions = 2 if pairs.planar else 3
        residual = (pairs.p_a - transform_points(T_a_b, pairs.p_b))[:, :dimensions]
        inlier = np.linalg.norm(residual, axis=1) <= self.noise_bound_m
        return supported(pairs, inlier, T_a_b)
