"""OpenCV's RANSAC for planar similarities, `estimateAffinePartial2D`."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.alignment import Pairs
from mapfusion.align.method import Fit, Undetermined, supported
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
