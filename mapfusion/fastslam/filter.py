"""FastSLAM 1.0 particle filter: one path per particle, one Kalman filter per particle and landmark.

Montemerlo, Thrun, Koller, Wegbreit (2002), in the paper's form (eq. 1-10) with these additions:
association per particle, a density for observations that match nothing, weights that are
multiplied until a resampling, resampling by effective sample size, and paths that bend where a
loop closes.
"""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from mapfusion.fastslam.association import (
    Association,
    associate,
    candidate_pairs,
    label_pairs,
    observation_sources,
)
from mapfusion.fastslam.landmarks import ActiveTracks
from mapfusion.fastslam.loop_closing import (
    DriftModel,
    FrameAssociation,
    close_loops,
    odometry_noise_factor,
)
from mapfusion.fastslam.measurement import (
    MapObservations,
    log_density_at_gate,
    observations_in_map,
    update_landmarks,
)
from mapfusion.fastslam.motion import MotionNoise, sample_motion
from mapfusion.fastslam.particles import ParticleMaps, PathHistory
from mapfusion.fastslam.proposal import Proposal, informed_disturbance, with_odometry_noise
from mapfusion.fastslam.resampling import effective_sample_size, normalised, systematic_ancestors
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import compose
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import Probability, Range, require_finite, require_in_range, require_shape
from mapfusion.robot_log import FILTERED_STRAY_M, Observations
from mapfusion.tables import NO_LABEL


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


@dataclass(frozen=True)
class StepResult:
    """The particles after weighting and before resampling.

    Attributes:
        best_pose: (3,) of the heaviest particle.
        effective_sample_size: 1 to M.
        resampled: whether a resampling followed.
        n_landmarks: of the heaviest particle, however often seen.
        cloud: (M, 3) poses.
        log_weights: (M,) normalised.
        log_evidence: log density of the frame's observations given all before. Its sum over a log
            tells which noise explains the data best, without the truth.
    """

    best_pose: Float
    effective_sample_size: float
    resampled: bool
    n_landmarks: int
    cloud: Float
    log_weights: Float
    log_evidence: float


class FastSlam:
    """The filter as a stream: one `step` for each frame of a robot, also those that saw nothing.

    Observations are numbered in the order in which they come; `source_observation` of a landmark
    is the number of the one it came from (the row of the log, if a log is streamed from its start).

    Args:
        parameters: settings.
        rng: of the motion and the resampling.
        keep_history: keep what `best_path` and `best_associations` tell. It grows with every step,
            by one particle's share once the particles' lines have met; without it the filter's
            memory grows with the map alone.
    """

    def __init__(
        self,
        parameters: FastSlamParameters,
        rng: np.random.Generator,
        keep_history: bool = True,
    ) -> None:
        self.parameters = parameters
        self._rng = rng
        self._poses = np.zeros((parameters.n_particles, 3))
        self._log_weights = np.full(parameters.n_particles, -np.log(parameters.n_particles))
        self._planar = bool(parameters.planar)
        self._tracked, self._stray_m2 = ActiveTracks(), 2 * parameters.stray_m**2
        self._maps = ParticleMaps(parameters.n_particles, parameters.gate)
        self._best = 0
        self._n_observations = 0
        self._slot_of_label: dict[int, int] = {}
        self._has_descriptors = self._has_labels = False
        self._history = PathHistory() if keep_history else None
        self._bends = DriftModel()

    @property
    def n_slots(self) -> int:
        """Distinct landmarks that the particles hold between them."""
        return self._maps.n_slots

    @property
    def n_rows(self) -> int:
        """Those of them that the particles may estimate differently, M times the memory each."""
        return self._maps.n_rows

    def step(
        self, odometry: Float, observations: Observations, sigma: Float | None = None
    ) -> StepResult:
        """Take in one frame: predict, associate, update, weigh, resample.

        Args:
            odometry: (3,) motion since the frame before, in the robot frame of the frame before.
            observations: what the frame shows; may be none.
            sigma: (3,) standard deviations of the odometry; None: as the motion noise has them.

        Returns:
            The particles after weighting and before resampling.

        Raises:
            ValueError: odometry is not three finite numbers, a covariance is not positive definite,
                or descriptors or labels are missing that the association needs. The filter is as it
                was before then.
        """
        odometry = np.asarray(odometry, dtype=np.float64)
        self._check(odometry, observations)
        noise, log_new = self._noise(observations)
        planar = self._planar
        sigma = self.parameters.motion.standard_deviations(odometry) if sigma is None else sigma

        self._maps.widen(self._tracked.ended(observations.track, self._maps.slots), self._stray_m2)
        self._poses, log_ratio = self._propose(odometry, sigma, observations, noise)
        seen = observations_in_map(self._poses, observations.position_m, noise, planar)
        chosen, changed = self._associate(seen, observations)
        slots = self._maps.slots
        log_likelihood = update_landmarks(slots.own, slots.row, chosen, seen, log_new, planar)
        self._maps.moved(changed)
        created = self._start_landmarks(chosen, seen, observations)
        self._maps.slots.last_frame[np.concatenate([changed, created[:, 1]])] = self._bends.frame
        self._tracked.went_into(observations.track, chosen, created, self._maps.slots)
        log_evidence = self._weigh(log_likelihood + log_ratio)
        self._remember(chosen)
        return self._resample(log_evidence)

    def best_map(self, min_count: int = 3) -> LandmarkMap:
        """The heaviest particle's landmarks that were seen at least `min_count` times, by age."""
        which, known = self._maps.of_particle(self._best, min_count)
        slots = self._maps.slots
        covariance = known.covariance_m2[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        return LandmarkMap(
            position_m=known.mean_m,
            covariance_m2=covariance,
            count=known.count,
            source_observation=slots.source[which],
            descriptor=slots.descriptor[which] if self._has_descriptors else None,
            label=slots.label[which] if self._has_labels else None,
            planar=self._planar,
        )

    def best_path(self) -> Float:
        """Poses (steps, 3) of the heaviest particle and its ancestors.

        Raises:
            ValueError: the history was not kept.
        """
        return self._kept_history().path(self._best)

    def best_associations(self) -> np.ndarray:
        """For each observation so far the source of the heaviest particle's landmark it went into.

        (n,) int64, -1 where the observation was dropped.

        Raises:
            ValueError: the history was not kept.
        """
        return self._kept_history().associations(self._best)

    def _check(self, odometry: Float, observations: Observations) -> None:
        """Refuse a frame before anything has changed."""
        require_shape("odometry", odometry, (3,))
        require_finite("odometry", odometry)
        if len(observations) == 0:
            return
        needed = {Association.DESCRIPTOR: "descriptor", Association.LABEL: "label"}
        name = needed.get(self.parameters.association)
        if name is None:
            return
        values = getattr(observations, name)
        if values is None or (name == "label" and np.any(values == NO_LABEL)):
            raise ValueError(f"{name}: observations have none, and the association needs it")

    def _noise(self, observations: Observations) -> tuple[Float, Float]:
        """R_t (K, 3, 3) with the filter's own additions, and log p_new (K,)."""
        settings = self.parameters
        noise = observations.covariance_m2 + settings.noise_floor_m**2 * np.eye(3)
        # The landmark seen once has lost its track. Without its stray no match, however good, would
        # outweigh a new landmark at a near wall, where R is a fraction of a millimetre.
        stray_m = 0.0 if observations.track is None else settings.stray_m
        seen_once = noise + stray_m**2 * np.eye(3)
        log_new = log_density_at_gate(seen_once, settings.gate, self._planar)
        if settings.log_new_landmark_density is not None:
            log_new[:] = settings.log_new_landmark_density
        return noise, log_new

    def _propose(
        self, odometry: Float, sigma: Float, observations: Observations, noise: Float
    ) -> tuple[Float, Float]:
        """Where the particles are after a motion.

        Poses (M, 3), and (M,) log of eq. 3's density over the density they were drawn from.
        """
        settings = self.parameters
        empty = self._maps.n_slots == 0
        # a robot that stands still is where it was, and without observations there is no news
        seeing = len(observations) and sigma.any() and not empty
        if not (settings.proposal is Proposal.INFORMED and seeing):
            moved = odometry_noise_factor(self._poses[self._best], 0.0, sigma)
            self._bends.went_on(moved @ moved.T)
            # Before the first landmark no draw is better than another, nor ever will be: whichever
            # particle is left would have turned the map by its own error beside the odometry's.
            disturbed = np.zeros(3) if empty else sigma
            poses = sample_motion(self._poses, odometry, disturbed, self._rng)
            return poses, np.zeros(settings.n_particles)
        predicted = compose(self._poses, odometry)
        seen = observations_in_map(predicted, observations.position_m, noise, self._planar)
        wide = with_odometry_noise(seen, predicted, odometry, sigma)
        chosen, _ = self._associate(wide, observations)
        if settings.close_loops and self._close_loops(chosen, seen, predicted, odometry, sigma):
            predicted = compose(self._poses, odometry)
            seen = observations_in_map(predicted, observations.position_m, noise, self._planar)
        slots = self._maps.slots
        eta, log_ratio = informed_disturbance(
            slots.own,
            slots.row,
            chosen,
            seen,
            predicted,
            odometry[2],
            sigma,
            settings.gate,
            self._planar,
            self._rng.standard_normal(predicted.shape),
        )
        return compose(self._poses, odometry + sigma * eta), log_ratio

    def _close_loops(
        self,
        chosen: np.ndarray,
        seen: MapObservations,
        predicted: Float,
        odometry: Float,
        sigma: Float,
    ) -> bool:
        """Bend all particles' paths and maps by what the best one sees again; whether they were."""
        m, settings, bends = self._best, self.parameters, self._bends
        frame = FrameAssociation(chosen[:, m].copy(), seen, m, settings.gate, self._planar)
        by_odometry = odometry_noise_factor(predicted[m], odometry[2], sigma)
        slots, probability = self._maps.slots, settings.gate_probability
        drift = close_loops(bends, slots, frame, by_odometry, probability)
        bent = bends.due(predicted[m, :2])
        if bent is not None:
            if self._history is not None:
                self._history.bent(bends.at(bent, np.arange(bends.frame + 1)))
            self._poses = compose(bent[-1], self._poses)
            self._maps.bend(bends.at(bent, slots.last_frame))
        bends.went_on(drift)
        return bent is not None

    def _associate(
        self, seen: MapObservations, observations: Observations
    ) -> tuple[np.ndarray, np.ndarray]:
        """(K, M) slot of each observation in each particle, or NEW or DROPPED; the slots chosen."""
        settings = self.parameters
        may_create = np.ones(len(observations), dtype=bool)
        if len(observations) == 0:
            return np.empty(seen.point_m.shape[:2], dtype=np.int64), np.empty(0, dtype=np.int64)
        if settings.association is Association.LABEL:
            assert observations.label is not None
            pairs, may_create = label_pairs(self._slot_of_label, observations.label)
        elif settings.association is Association.DESCRIPTOR:
            pairs = candidate_pairs(
                self._maps,
                seen,
                settings.gate,
                observations.descriptor,
                settings.descriptor_threshold,
            )
        else:
            pairs = candidate_pairs(self._maps, seen, settings.gate)
        nearest = settings.association is Association.GATE
        return associate(self._maps, pairs, seen, may_create, settings.gate, self._planar, nearest)

    def _start_landmarks(
        self, chosen: np.ndarray, seen: MapObservations, observations: Observations
    ) -> np.ndarray:
        """A landmark for each observation that is NEW in some particle: rows and slots (n, 2)."""
        if len(observations) == 0:
            return np.empty((0, 2), dtype=np.int64)
        created, rows = self._maps.create(chosen, seen, observations, self._n_observations)
        if self.parameters.association is Association.LABEL:
            assert observations.label is not None
            labels = observations.label[rows].tolist()
            self._slot_of_label.update(zip(labels, created.tolist(), strict=True))
        self._has_descriptors |= observations.descriptor is not None
        self._has_labels |= observations.label is not None
        return np.stack([rows, created], axis=1)

    def _weigh(self, log_likelihood: Float) -> float:
        """Multiply the weights by the frame's likelihood (eq. 10).

        Returns:
            Log density of the frame's observations given all before.
        """
        self._log_weights, log_evidence = normalised(self._log_weights + log_likelihood)
        self._best = int(np.argmax(self._log_weights))
        return log_evidence

    def _remember(self, chosen: np.ndarray) -> None:
        """Number the observations, and keep what became of them."""
        if self._history is not None:
            source = observation_sources(self._maps.slots, chosen, self._n_observations)
            self._history.add(self._poses, source)
        self._n_observations += len(chosen)

    def _resample(self, log_evidence: float) -> StepResult:
        """Take the result; then replace light particles by heavy ones if few carry the weight."""
        n_particles = self.parameters.n_particles
        n_effective = effective_sample_size(self._log_weights)
        few = n_effective <= self.parameters.resample_fraction * n_particles
        result = StepResult(
            best_pose=self._poses[self._best],
            effective_sample_size=n_effective,
            resampled=few,
            n_landmarks=int(self._maps.n_landmarks[self._best]),
            cloud=self._poses,
            log_weights=self._log_weights,
            log_evidence=log_evidence,
        )
        if few:
            ancestors = systematic_ancestors(self._log_weights, self._rng)
            self._poses = self._poses[ancestors]
            self._maps.resampled(ancestors)
            self._log_weights = np.full(n_particles, -np.log(n_particles))
            if self._history is not None:
                self._history.resampled(ancestors)
            self._best = int(np.searchsorted(ancestors, self._best))
        return result

    def _kept_history(self) -> PathHistory:
        if self._history is None:
            raise ValueError("keep_history: is False, the path was not kept")
        return self._history
