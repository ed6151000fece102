"""FastSLAM 1.0 particle filter: one path per particle, one Kalman filter per particle and landmark.

Montemerlo, Thrun, Koller, Wegbreit (2002), in the paper's form (eq. 1-10) with these additions:
data association per particle, a density for observations without a match, weights that accumulate
until a resampling, resampling by effective sample size, and a correction of the path at loop
closures.
"""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from mapfusion.descriptors import DescriptorKind, euclidean_distance_at
from mapfusion.fastslam.association import (
    Association,
    associate,
    candidate_pairs,
    label_pairs,
)
from mapfusion.fastslam.landmark_arrays import ActiveTracks
from mapfusion.fastslam.loop_closing import (
    DriftModel,
    FrameAssociation,
    close_loops,
    odometry_noise_factor,
)
from mapfusion.fastslam.measurement import (
    DROPPED,
    NEW,
    MapObservations,
    log_density_at_gate,
    observations_in_map,
    update_landmarks,
)
from mapfusion.fastslam.motion import MotionNoise, sample_motion
from mapfusion.fastslam.particles import ParticleMaps, PathHistory
from mapfusion.fastslam.proposal import Proposal, informed_disturbance, with_odometry_noise
from mapfusion.fastslam.resampling import effective_sample_size, normalised, systematic_ancestors
from mapfusion.geometry.numerics import Float, chi_square_bound, require_finite, require_shape
from mapfusion.geometry.se2 import IDENTITY, compose, motion_jacobian
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import Probability, Range, require_in_range
from mapfusion.robot_log import FILTERED_STRAY_M, Observations
from mapfusion.tables import NO_LABEL


@dataclass(frozen=True)
class FastSlamParameters:
    """Settings of the filter; the defaults are recommended.

    Attributes:
        n_particles: M.
        motion: noise of the odometry.
        proposal: distribution from which particles are sampled. `motion` is the paper's eq. 3; with
            it, few particles survive if observations are much more precise than the odometry.
        association: criterion that selects among the landmarks inside the gate.
        gate_probability: share of true matches inside the gate (chi-square quantile). Close to 1,
            since a landmark's covariance omits the drift since it was last seen; inside the gate
            the descriptors decide.
        descriptor_threshold: largest distance of matching descriptors of any kind: 0 is equal, 0.8
            the median of different landmarks.
        resample_fraction: resample when the effective sample size is at most this share of M;
            0 never, 1 in every step.
        stray_m: standard deviation, per axis, of the offset between the landmark and the point that
            a track of observations shows; each track has its own offset.
        close_loops: correct the past path and the map when landmarks come into view again (see
            `loop_closing.py`); only with the informed proposal.
        noise_floor_m: standard deviation added to each coordinate of an observation.
        log_new_landmark_density: log of p_new in 1/m^3 (1/m^2 in planar data), the density of an
            observation without a match. None: the density of a match at the gate, with the
            covariance of a landmark seen once, and its offset if it has a track.
        planar: z carries no information; gates and weights have 2 degrees of freedom. None: from
            the log; False in a filter without a log.
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
    """State of the particles after weighting and before resampling.

    Attributes:
        best_pose: (3,) pose of the heaviest particle.
        effective_sample_size: 1 to M.
        resampled: True if a resampling followed.
        n_landmarks: number of landmarks of the heaviest particle.
        cloud: (M, 3) poses.
        log_weights: (M,) normalised.
        log_evidence: log density of the frame's observations given all earlier ones. Its sum over a
            log measures how well the assumed noise explains the data, without the truth.
    """

    best_pose: Float
    effective_sample_size: float
    resampled: bool
    n_landmarks: int
    cloud: Float
    log_weights: Float
    log_evidence: float


@dataclass(frozen=True)
class PriorMap:
    """Map and path of T frames from which a filter goes on.

    The errors of the map are drift, a small motion of the plane that depends on the frame that last
    showed a landmark, plus an independent error of each landmark. A landmark that other robots
    observed has a frame of theirs. Such frames are numbered by negative numbers.

    Attributes:
        landmarks: N landmarks with the covariances of their independent errors.
        source: numbers that identify the landmarks, shape (N,).
        last_frame: last frame that showed each landmark, shape (N,).
        path: poses of the robot, shape (T, 3).
        associations: source of the landmark of each observation so far, -1 for none, shape (n,).
        frame_starts: index of the first observation of each frame, and n, shape (T + 1,).
        knots: frames of the drift, ascending and before T - 1, shape (K,).
        drift_covariance: covariance of the drift at the knots and in frame T - 1, shape
            (3K + 3, 3K + 3).
    """

    landmarks: LandmarkMap
    source: np.ndarray
    last_frame: np.ndarray
    path: Float
    associations: np.ndarray
    frame_starts: np.ndarray
    knots: np.ndarray
    drift_covariance: Float


class FastSlam:
    """FastSLAM filter for a stream of frames.

    Call `step` once for each frame, also for frames without observations. Observations are numbered
    in their order; `source_observation` of a landmark is the number of the observation that created
    it (the row of the log, if a log is filtered from its start).

    Args:
        parameters: settings.
        rng: random generator of the sampling and the resampling.
        keep_history: store the paths and associations for `best_path` and `best_associations`. The
            stored history grows with every step; without it, memory depends on the map alone.
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
        self._descriptor_kind: DescriptorKind | None = None
        self._has_labels = self._has_tracks = False
        self._history = PathHistory() if keep_history else None
        self._drift_model = DriftModel()

    @property
    def n_slots(self) -> int:
        """Number of distinct landmarks in all particles."""
        return self._maps.n_slots

    @property
    def n_rows(self) -> int:
        """Number of landmarks with one estimate per particle; the others share one estimate."""
        return self._maps.n_rows

    def step(
        self, odometry: Float, observations: Observations, sigma: Float | None = None
    ) -> StepResult:
        """Process one frame: predict, associate, update, weigh, resample.

        Args:
            odometry: (3,) motion since the frame before, in the robot frame of the frame before.
            observations: of the frame; may be empty.
            sigma: (3,) standard deviations of the odometry; None: from the motion noise.

        Returns:
            The particles after weighting and before resampling.

        Raises:
            ValueError: odometry is not three finite numbers, a covariance is not positive definite,
                descriptors or labels that the association needs are missing, or descriptors are of
                another kind than before. The filter is then unchanged.
        """
        odometry = np.asarray(odometry, dtype=np.float64)
        require_shape("odometry", odometry, (3,))
        require_finite("odometry", odometry)
        settings, planar, maps = self.parameters, self._planar, self._maps
        needed = {Association.DESCRIPTOR: "descriptor", Association.LABEL: "label"}
        name = needed.get(settings.association)
        if name is not None and len(observations):
            values = getattr(observations, name)
            if values is None or (name == "label" and np.any(values == NO_LABEL)):
                raise ValueError(f"{name}: observations have none, and the association needs it")
        kind, previous_kind = observations.descriptor_kind, self._descriptor_kind
        if kind is not None and previous_kind is not None and kind.differs_from(previous_kind):
            raise ValueError(f"descriptor: is {kind}, earlier ones were {previous_kind}")

        # R_t (K, 3, 3) and log p_new (K,). A landmark seen once has lost its track. Without the
        # offset of its track, every match would be less likely than a new landmark where R is
        # small.
        noise = observations.covariance_m2 + settings.noise_floor_m**2 * np.eye(3)
        stray_m = 0.0 if observations.track is None else settings.stray_m
        seen_once = noise + stray_m**2 * np.eye(3)
        log_new = log_density_at_gate(seen_once, settings.gate, planar)
        if settings.log_new_landmark_density is not None:
            log_new[:] = settings.log_new_landmark_density
        sigma = settings.motion.standard_deviations(odometry) if sigma is None else sigma

        # Predict: landmarks lose certainty at the end of their tracks, and the poses move.
        maps.inflate(
            self._tracked.slots_of_ended_tracks(observations.track, maps.slots), self._stray_m2
        )
        self._poses, log_ratio = self._propose(odometry, sigma, observations, noise)

        # Associate and update the landmarks (eq. 4-9), and create new ones.
        seen = observations_in_map(self._poses, observations.position_m, noise, planar)
        chosen, changed = self._associate(seen, observations)
        slots = maps.slots
        log_likelihood = update_landmarks(
            slots.by_particle, slots.row, chosen, seen, log_new, planar
        )
        maps.update_boxes(changed)
        created, rows = maps.create(chosen, seen, observations, self._n_observations)
        if len(observations):
            if settings.association is Association.LABEL:
                assert observations.label is not None
                labels = observations.label[rows].tolist()
                self._slot_of_label.update(zip(labels, created.tolist(), strict=True))
            if self._descriptor_kind is None:
                self._descriptor_kind = observations.descriptor_kind
            self._has_labels |= observations.label is not None
            self._has_tracks |= observations.track is not None
        maps.slots.last_frame[np.concatenate([changed, created])] = self._drift_model.frame
        pairs = np.stack([rows, created], axis=1)
        self._tracked.update(observations.track, chosen, pairs, maps.slots)

        # Weigh (eq. 10).
        log_weights = self._log_weights + (log_likelihood + log_ratio)
        self._log_weights, log_evidence = normalised(log_weights)
        self._best = int(np.argmax(self._log_weights))
        if self._history is not None:
            # Source (K, M) of the landmark of each observation, -1 for dropped ones.
            observation_number = self._n_observations + np.arange(len(chosen))[:, None]
            source = np.where(chosen == NEW, observation_number, maps.slots.source[chosen])
            source = np.where(chosen == DROPPED, -1, source).astype(np.int32)
            self._history.add(self._poses, source)
        self._n_observations += len(chosen)
        n_effective = effective_sample_size(self._log_weights)
        must_resample = n_effective <= settings.resample_fraction * settings.n_particles
        result = StepResult(
            best_pose=self._poses[self._best],
            effective_sample_size=n_effective,
            resampled=must_resample,
            n_landmarks=int(maps.n_landmarks[self._best]),
            cloud=self._poses,
            log_weights=self._log_weights,
            log_evidence=log_evidence,
        )
        if must_resample:  # replace particles of low weight by copies of heavy ones
            ancestors = systematic_ancestors(self._log_weights, self._rng)
            self._poses = self._poses[ancestors]
            maps.resample(ancestors)
            self._log_weights = np.full(settings.n_particles, -np.log(settings.n_particles))
            if self._history is not None:
                self._history.resample(ancestors)
            self._best = int(np.searchsorted(ancestors, self._best))
        return result

    def restart(self, prior: PriorMap) -> None:
        """Replace maps and paths of all particles by one map and one path.

        The filter must have processed the frames of the path, with the same observations.
        """
        n_particles = self.parameters.n_particles
        landmarks, last = prior.landmarks, len(prior.path) - 1
        self._maps = ParticleMaps(n_particles, self.parameters.gate)
        slot_indices = self._maps.add_common(landmarks, prior.source, prior.last_frame)
        self._drift_model = DriftModel.at_knots(last, prior.knots, prior.drift_covariance)
        self._poses = np.tile(prior.path[-1], (n_particles, 1))
        self._log_weights = np.full(n_particles, -np.log(n_particles))
        self._tracked, self._best = ActiveTracks(), 0
        if self._descriptor_kind is None:
            self._descriptor_kind = landmarks.descriptor_kind
        labels = [] if landmarks.label is None else landmarks.label.tolist()
        known = zip(labels, slot_indices.tolist(), strict=False)
        self._slot_of_label = {label: slot for label, slot in known if label != NO_LABEL}
        if self._history is not None:
            sources = np.split(prior.associations, prior.frame_starts[1:-1])
            self._history = PathHistory.of_path(prior.path, sources, n_particles)

    def best_map(self, min_count: int = 3, with_drift: bool = False) -> LandmarkMap:
        """Return the heaviest particle's landmarks seen at least `min_count` times, by age.

        Args:
            min_count: smallest number of observations of a landmark.
            with_drift: return marginal covariances of the landmarks. The filter's are conditional
                on the path, and of the point that the landmark's present or next track shows.
        """
        slot_indices, estimates = self._maps.landmarks_of(self._best, min_count)
        slots = self._maps.slots
        covariance = estimates.covariance_m2[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        if with_drift and len(slot_indices):
            drift = self._drift_model.covariances(slots.last_frame[slot_indices])
            by_drift = motion_jacobian(IDENTITY, estimates.mean_m)
            covariance[:, :2, :2] += by_drift @ drift @ np.swapaxes(by_drift, 1, 2)
            if self._has_tracks:
                is_tracked = np.isin(slot_indices, self._tracked.slots)
                offset_m2 = np.where(is_tracked, 1.0, -1.0) * self._stray_m2 / 2
                covariance[:, range(3), range(3)] += offset_m2[:, None]
        return LandmarkMap(
            position_m=estimates.mean_m,
            covariance_m2=covariance,
            count=estimates.count,
            source_observation=slots.source[slot_indices],
            descriptor=None if self._descriptor_kind is None else slots.descriptor[slot_indices],
            label=slots.label[slot_indices] if self._has_labels else None,
            planar=self._planar,
            descriptor_kind=self._descriptor_kind,
        )

    def best_path(self) -> Float:
        """Return the poses (steps, 3) of the heaviest particle and its ancestors.

        Raises:
            ValueError: `keep_history` is False.
        """
        return self._kept_history().path(self._best)

    def best_associations(self) -> np.ndarray:
        """Return the source (n,) int64 of the heaviest particle's landmark of each observation.

        The source is -1 for an observation that was dropped.

        Raises:
            ValueError: `keep_history` is False.
        """
        return self._kept_history().associations(self._best)

    def last_associations(self) -> np.ndarray:
        """Return `best_associations` of the observations of the last step, shape (K,).

        Raises:
            ValueError: `keep_history` is False.
        """
        return self._kept_history().last_associations(self._best)

    def _propose(
        self, odometry: Float, sigma: Float, observations: Observations, noise: Float
    ) -> tuple[Float, Float]:
        """Sample the poses after a motion, and close loops.

        Returns:
            (M, 3) poses, and (M,) log of eq. 3's density over the density of the proposal.
        """
        settings = self.parameters
        empty = self._maps.n_slots == 0
        # without motion or observations, the informed proposal equals the motion proposal
        informative = len(observations) and sigma.any() and not empty
        if not (settings.proposal is Proposal.INFORMED and informative):
            moved = odometry_noise_factor(self._poses[self._best], 0.0, sigma)
            self._drift_model.add_frame(moved @ moved.T)
            # Before the first landmark, particles are not disturbed: no observation could ever
            # correct the disturbance, which would only rotate and shift the map.
            disturbed = np.zeros(3) if empty else sigma
            poses = sample_motion(self._poses, odometry, disturbed, self._rng)
            return poses, np.zeros(settings.n_particles)
        predicted = compose(self._poses, odometry)
        seen = observations_in_map(predicted, observations.position_m, noise, self._planar)
        widened = with_odometry_noise(seen, predicted, odometry, sigma)
        chosen, _ = self._associate(widened, observations)
        if settings.close_loops and self._close_loops(chosen, seen, predicted, odometry, sigma):
            predicted = compose(self._poses, odometry)
            seen = observations_in_map(predicted, observations.position_m, noise, self._planar)
        slots = self._maps.slots
        eta, log_ratio = informed_disturbance(
            slots.by_particle,
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
        """Correct all particles by the loops that the best one closes; return True if corrected."""
        m, settings, drift_model = self._best, self.parameters, self._drift_model
        frame = FrameAssociation(chosen[:, m].copy(), seen, m, settings.gate, self._planar)
        noise_factor = odometry_noise_factor(predicted[m], odometry[2], sigma)
        slots, probability = self._maps.slots, settings.gate_probability
        drift = close_loops(drift_model, slots, frame, noise_factor, probability)
        correction = drift_model.take_correction(predicted[m, :2])
        if correction is not None:
            if self._history is not None:
                self._history.correct(
                    drift_model.interpolate(correction, np.arange(drift_model.frame + 1))
                )
            self._poses = compose(correction[-1], self._poses)
            self._maps.transform(drift_model.interpolate(correction, slots.last_frame))
        drift_model.add_frame(drift)
        return correction is not None

    def _associate(
        self, seen: MapObservations, observations: Observations
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return slots (K, M), NEW or DROPPED, of each observation; and the distinct slots."""
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
                euclidean_distance_at(settings.descriptor_threshold, observations.descriptor_kind),
            )
        else:
            pairs = candidate_pairs(self._maps, seen, settings.gate)
        nearest = settings.association is Association.GATE
        return associate(self._maps, pairs, seen, may_create, settings.gate, self._planar, nearest)

    def _kept_history(self) -> PathHistory:
        if self._history is None:
            raise ValueError("keep_history: is False, the path was not kept")
        return self._history
