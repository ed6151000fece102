"""Settings of the filter."""

from dataclasses import dataclass, field

from scipy.special import chdtri

from mapfusion.fastslam.association import Association
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.fastslam.proposal import Proposal


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
        noise_scale: factor on the observations' standard deviations; the paper's is 1. Above 1 for
            errors that are alike from frame to frame, as those of a corner are. Taken as
            independent news they make each particle's map so certain that no particle finds its
            old landmarks again when a loop closes.
        noise_floor_m: standard deviation added to each coordinate of an observation.
        log_new_landmark_density: log of p_new in 1/m^3 (1/m^2 in planar data), the density of an
            observation that matches nothing; None: that of a match exactly at the gate, with the
            covariance of a landmark seen once.
        planar: z carries no information; gates and weights have 2 degrees of freedom. None: as the
            log says; of a filter without a log, no.
    """

    n_particles: int = 200
    motion: MotionNoise = field(default_factory=MotionNoise)
    proposal: Proposal = Proposal.INFORMED
    association: Association = Association.DESCRIPTOR
    gate_probability: float = 0.9999
    descriptor_threshold: float = 0.5
    resample_fraction: float = 0.5
    noise_scale: float = 4.0
    noise_floor_m: float = 0.0
    log_new_landmark_density: float | None = None
    planar: bool | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "proposal", Proposal(self.proposal))
        object.__setattr__(self, "association", Association(self.association))
        if self.n_particles < 1:
            raise ValueError(f"n_particles: is {self.n_particles}, must be at least 1")
        if not 0 < self.gate_probability < 1:
            raise ValueError(f"gate_probability: is {self.gate_probability}, must be in (0, 1)")
        if not 0 <= self.resample_fraction <= 1:
            raise ValueError(f"resample_fraction: is {self.resample_fraction}, must be in [0, 1]")
        if not self.descriptor_threshold > 0:
            raise ValueError(
                f"descriptor_threshold: is {self.descriptor_threshold}, must be positive"
            )
        if not self.noise_scale > 0:
            raise ValueError(f"noise_scale: is {self.noise_scale}, must be positive")
        if not self.noise_floor_m >= 0:
            raise ValueError(f"noise_floor_m: is {self.noise_floor_m}, must not be negative")

    @property
    def gate(self) -> float:
        """Largest squared Mahalanobis distance of a match."""
        return float(chdtri(2 if self.planar else 3, 1 - self.gate_probability))
