"""KISS-Matcher (Lim et al. 2024): pruning by pairwise consistency, then GNC for yaw and shift."""

import importlib
import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from mapfusion.align.alignment import Pairs
from mapfusion.align.method import Fit, Undetermined, supported
from mapfusion.geometry.se2 import transform_points
from mapfusion.parameters import Range, require_in_range

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
