"""Settings of the filter."""

from dataclasses import dataclass, field
from typing import Annotated

from mapfusion.arguments import Probability, Range, require_in_range
from mapfusion.chi_square import chi_square_bound
from mapfusion.fastslam.association import Association
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.fastslam.proposal import Proposal
from mapfusion.stray import FILTERED_STRAY_M


@dataclass(frozen=True)
class FastSlamParameters:
    """Settings of the filter; the defaults are the recommended ones.

    Attributes:
        n_particles: M.
        motion: noise of the odometry.
        proposal: what particles are drawn from. `motion` is the paper's eq. 3, which leaves few of
            them where observations are far sharper than the odometry.
        association: what decides among the landmarks inside the gate.
        gate_probability: share of true matches that the gate lets pass (chi-square quantile). Close
            to 1, as a landmark's covariance leaves out the drift since it was last seen; among
            those inside, the descriptors decide.
        descriptor_threshold: largest Euclidean distance of matching descriptors (unit vectors).
        resample_fraction: resample when the effective sample size is at most this share of M;
            0 never, 1 in every step.
        stray_m: standard deviation, along each axis, by which the point that one track of
            observations is of lies beside the landmark; the next track's lies elsewhere.
        close_loops: bend the path so far, and the map that hangs on it, where landmarks come back
            into view (see `bends.py`); with the informed proposal alone.
        noise_floor_m: standard deviation added to each coordinate of an observation.
        log_new_landmark_density: log of p_new in 1/m^3 (1/m^2 in planar data), the density of an
            observation that matches nothing; None: that of a match exactly at the gate, with the
            covariance of a landmark seen once, and its stray if it has a track.
        planar: z carries no information; gates and weights have 2 degrees of freedom. None: as the
            log says; of a filter without a log, no.
    """

    n_particles: Annotated[int, Range(1, 10_000, "particles")] = 200
    motion: MotionNoise = field(default_factory=MotionNoise)
    proposal: Proposal = Proposal.INFORMED
    association: Association = Association.DESCRIPTOR
    gate_probability: Probability = 0.9999
    descriptor_threshold: Annotated[float, Range(1e-3, 2, "1")] = 0.5
    resample_fraction: Annotated[float, Range(0, 1, "1")] = 0.5
    stray_m: Annotated[float, Range(0, 10, "m")] = FILTERED_STRAY_M
    close_loops: bool = True
    noise_floor_m: Annotated[float, Range(0, 10, "m")] = 0.0
    log_new_landmark_density: Annotated[float, Range(-100, 100, "ln 1/m^3")] | None = None
    planar: bool | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "proposal", Proposal(self.proposal))
        object.__setattr__(self, "association", Association(self.association))
        require_in_range(self)

    @property
    def gate(self) -> float:
        """Largest squared Mahalanobis distance of a match."""
        return chi_square_bound(self.gate_probability, 2 if self.planar else 3)
