"""Interface of aligners, and the built-in methods by name.

A method estimates a motion from correspondences. `MethodAligner` makes an aligner of it, which adds
refusal, covariance and time.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from mapfusion.align.alignment import (
    MIN_PAIRS,
    Alignment,
    Fit,
    Method,
    Needs,
    Pairs,
    Status,
    Undetermined,
    undetermined,
    why_too_few,
)
from mapfusion.align.clique import Clique
from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.covariance import alignment_covariance, estimate_drift_m
from mapfusion.align.gnc import Gnc
from mapfusion.align.icp import Icp, ImpIcp
from mapfusion.align.peers import KissMatcher, OpenCv
from mapfusion.align.ransac import Ransac, RansacMahalanobis
from mapfusion.align.rigid_motion import least_squares_gain, residual_covariances, residuals
from mapfusion.align.svd import Svd
from mapfusion.errors import did_you_mean
from mapfusion.landmark_map import LandmarkMap

ALIGNERS: dict[str, type[Method]] = {
    "ransac": Ransac,
    "svd": Svd,
    "icp": Icp,
    "impicp": ImpIcp,
    "gnc": Gnc,
    "clique": Clique,
    "ransac_mahalanobis": RansacMahalanobis,
}
PEERS: dict[str, type[Method]] = {"opencv": OpenCv, "kiss_matcher": KissMatcher}


def make_aligner(name: str, /, **parameters: Any) -> Method:
    """Construct a built-in method or peer by name.

    Raises:
        ValueError: the name or a parameter is unknown, or a parameter is out of range.
    """
    constructors = ALIGNERS | PEERS
    if name not in constructors:
        known_text = f"known are {', '.join(constructors)}{did_you_mean(name, constructors)}"
        raise ValueError(f"unknown aligner {name!r}, {known_text}")
    return construct(name, constructors[name], parameters)


def construct(name: str, constructor: Callable[..., Any], parameters: Mapping[str, Any]) -> Any:
    """Call the constructor of a method with parameters from a scenario file.

    Raises:
        ValueError: a parameter is unknown or out of range.
    """
    dataclass_like: Any = (
        constructor  # untyped, because is_dataclass would narrow the type to an instance
    )
    field_names = (
        [each.name for each in fields(dataclass_like)]
        if is_dataclass(dataclass_like)
        else list(parameters)
    )
    unknown_field = next((key for key in parameters if key not in field_names), None)
    if unknown_field is not None:
        known_text = (
            f"known: {', '.join(field_names) or 'none'}{did_you_mean(unknown_field, field_names)}"
        )
        raise ValueError(f"parameters: {name}: {unknown_field}: unknown; {known_text}")
    try:
        height = parameters.get("height", HeightGate())
        if isinstance(height, dict):
            parameters = {**parameters, "height": HeightGate(**height)}
        elif not isinstance(height, HeightGate):
            raise ValueError(f"parameters: {name}: height: expected probability and floor_m")
        return constructor(**parameters)
    except TypeError as error:
        raise ValueError(f"parameters: {name}: {error}") from error


class Aligner(Protocol):
    """Interface of a class that returns a complete `Alignment`."""

    @property
    def randomised(self) -> bool:
        """True if the result depends on the random generator."""
        ...

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b."""
        ...


@dataclass(frozen=True)
class MethodAligner:
    """Aligner from a method: selects its input and adds refusal, covariance and time."""

    method: Method

    @property
    def randomised(self) -> bool:
        """True if the result depends on the random generator."""
        return self.method.randomised

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b.

        Raises:
            ValueError: an index of the correspondences lies outside its map.
        """
        return self.align_pairs(Pairs(map_a, map_b, correspondences), rng)

    def align_pairs(self, pairs: Pairs, rng: np.random.Generator) -> Alignment:
        """Estimate T_a_b from pairs, for which the method may hold cached data."""
        started_s = time.perf_counter()
        height = getattr(self.method, "height", None)
        needs = getattr(self.method, "needs", None) or Needs()
        gate = height if isinstance(height, HeightGate) else None
        selection = _MethodInput.select(pairs, gate, needs)
        if selection.shortage:
            return undetermined(selection.shortage, len(pairs), started_s)
        found = self.method.find(selection.pairs, rng)
        if isinstance(found, Undetermined):
            return undetermined(found.reason, len(pairs), started_s)
        # equal fits give equal alignments
        fitted = None if found.fitted is None else found.fitted.correspondences
        indices = (None, None) if fitted is None else (fitted.index_a, fitted.index_b)
        arrays = (found.T_a_b, found.inlier, found.weight, found.gain, *indices)
        key = (
            *(None if array is None else np.asarray(array).tobytes() for array in arrays),
            found.gate_m,
            found.refusal,
        )
        alignment = selection.alignments.get(key)
        if alignment is None:
            alignment = alignment_of_fit(found, pairs, selection.rows, started_s)
            selection.alignments[key] = alignment
        return replace(alignment, elapsed_s=time.perf_counter() - started_s)


class _MethodInput(NamedTuple):
    """Pairs that a method gets of all pairs of two maps.

    Attributes:
        rows: (n,) rows of these pairs among all pairs.
        pairs: these pairs.
        shortage: reason why the pairs are not enough for the method; empty if they are.
        alignments: alignments of earlier fits to these pairs, by the content of the fit.
    """

    rows: np.ndarray
    pairs: Pairs
    shortage: str
    alignments: dict[tuple, Alignment]

    @classmethod
    def select(cls, pairs: Pairs, height: HeightGate | None, needs: Needs) -> "_MethodInput":
        """Return the input for a height gate and needs; equal calls share one object."""
        inputs: dict[tuple, _MethodInput] = pairs.cache.setdefault(cls, {})
        if (height, needs) not in inputs:
            rows = np.arange(len(pairs)) if height is None else pairs.of_one_height(height)
            given = pairs if len(rows) == len(pairs) else pairs[rows]
            shortage = pairs.correspondences.shortage
            reason = why_too_few(pairs.map_a, pairs.map_b, len(pairs), needs.pairs, shortage)
            if not reason and len(given) < needs.pairs:
                n, least = len(given), needs.pairs
                reason = f"the heights of {n} correspondences agree, at least {least} are needed"
            inputs[height, needs] = cls(rows, given, reason or needs.why_without_extent(given), {})
        return inputs[height, needs]


def alignment_of_fit(
    fit: Fit | Undetermined, pairs: Pairs, rows: np.ndarray, started_s: float
) -> Alignment:
    """Return the alignment of a fit, with drift and covariance estimated from the residuals.

    Args:
        fit: result of the method.
        pairs: all N pairs.
        rows: (n,) rows of the pairs that the method got.
        started_s: `time.perf_counter()` at the start.
    """
    if isinstance(fit, Undetermined):
        return undetermined(fit.reason, len(pairs), started_s)
    inlier = np.zeros(len(pairs), dtype=bool)
    inlier[rows[fit.inlier]] = True
    fitted = pairs[inlier] if fit.fitted is None else fit.fitted
    refusal, n_inliers = fit.refusal, int(np.count_nonzero(inlier))
    if n_inliers < MIN_PAIRS and not refusal:
        refusal = f"{n_inliers} correspondences agree, at least {MIN_PAIRS} are needed"
    covariance, drift, lower_bound = np.full((3, 3), np.nan), np.nan, True
    if len(fitted) >= 2:
        gain = fit.gain
        if gain is None:
            gain = least_squares_gain(fit.T_a_b, fitted.p_b, fit.weight)
        residual_covariance = residual_covariances(
            fit.T_a_b, fitted.covariance_a, fitted.covariance_b
        )
        e = residuals(fit.T_a_b, fitted.p_a, fitted.p_b)
        drift = estimate_drift_m(e, residual_covariance, fit.gate_m)
        covariance, lower_bound = alignment_covariance(fit.T_a_b, fitted, gain, drift)
    return Alignment(
        fit.T_a_b,
        covariance,
        inlier,
        time.perf_counter() - started_s,
        Status.REFUSED if refusal else Status.ACCEPTED,
        refusal,
        drift,
        lower_bound,
    )


def as_aligner(method: Method | Aligner) -> Aligner:
    """Return an aligner for a method: the method itself if it has `align`."""
    return method if hasattr(method, "align") else MethodAligner(method)  # type: ignore[return-value]
