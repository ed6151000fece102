"""What an aligner returns: a value, also when it failed."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from mapfusion.se2 import Float


class Status(StrEnum):
    """Outcome of an alignment."""

    ACCEPTED = "accepted"
    REFUSED = "refused"  # an answer was found and is not to be trusted
    AMBIGUOUS = "ambiguous"  # it fits, and so may another: the maps do not tell which
    TOO_UNCERTAIN = "too_uncertain"  # right by its pairs, useless by its covariance
    DEGENERATE = "degenerate"  # the data do not determine an answer
    FAILED = "failed"  # the method raised, hung, ended its process or answered nonsense
    ABSENT = "absent"  # the package behind the method is not installed


NOT_RUN = frozenset({Status.FAILED, Status.ABSENT})  # nothing can be said about the maps


@dataclass(frozen=True)
class Alignment:
    """An estimate of T_a_b (frame b into frame a) from correspondences between two maps.

    Attributes:
        T_a_b: (3,) tx_m, ty_m, theta_rad (counter-clockwise); NaN when degenerate.
        covariance: (3, 3) of T_a_b for residuals that are independent, s_drift included, and for
            what the cameras' calibration leaves open; NaN when degenerate. What drift has in common
            over a whole map leaves no residual and is not in it, so that real errors are larger:
            the evaluation reports the NEES.
        inlier: (N,) bool over the correspondences given.
        elapsed_s: time of the estimation.
        status: accepted, refused or degenerate by its method, ambiguous and too uncertain by the
            verdict; failed and absent come from the harness alone.
        reason: empty when accepted, else what a person can act on.
        drift_sigma_m: s_drift, the standard deviation per axis of the residuals of pairs beyond
            what the landmarks' covariances explain (both maps together); NaN when degenerate.
    """

    T_a_b: Float
    covariance: Float
    inlier: np.ndarray
    elapsed_s: float
    status: Status
    reason: str = ""
    drift_sigma_m: float = float("nan")

    @property
    def ok(self) -> bool:
        """Whether the estimate may be used."""
        return self.status is Status.ACCEPTED


def degenerate(reason: str, n_correspondences: int, elapsed_s: float = 0.0) -> Alignment:
    """The result for data that determine no alignment."""
    return without_answer(Status.DEGENERATE, reason, n_correspondences, elapsed_s)


def without_answer(
    status: Status, reason: str, n_correspondences: int, elapsed_s: float = float("nan")
) -> Alignment:
    """A result that holds no motion."""
    return Alignment(
        np.full(3, np.nan),
        np.full((3, 3), np.nan),
        np.zeros(n_correspondences, dtype=bool),
        elapsed_s,
        status,
        reason,
    )
