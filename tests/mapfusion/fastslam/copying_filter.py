"""Reference FastSLAM from the equations: each particle has its own map, resampling copies it.

Slow and obvious, with matrices in the robot frame. It draws the same random numbers as the filter.
"""

import copy
from dataclasses import dataclass

import numpy as np
from scipy.stats import multivariate_normal

from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fastslam.motion import sample_motion
from mapfusion.fastslam.resampling import systematic_ancestors
from mapfusion.geometry.se2 import compose, rotation_about_z, transform_points
from mapfusion.robot_log import Observations


@dataclass
class Landmark:
    mean: np.ndarray
    covariance: np.ndarray
    count: int
    source: int
    descriptor: np.ndarray | None
    label: int | None


@dataclass
class Particle:
    pose: np.ndarray
    weight: float
    landmarks: dict[int, Landmark]
    path: list
    associations: list

    def copied(self) -> "Particle":
        # their arrays are replaced, never written into
        landmarks = {number: copy.copy(m) for number, m in self.landmarks.items()}
        return Particle(
            self.pose.copy(), self.weight, landmarks, list(self.path), list(self.associations)
        )


class CopyingFilter:
    def __init__(self, parameters: FastSlamParameters, rng: np.random.Generator) -> None:
        self.parameters = parameters
        self.rng = rng
        m = parameters.n_particles
        self.particles = [Particle(np.zeros(3), 1 / m, {}, [], []) for _ in range(m)]
        self.best = self.particles[0]
        self.n_observations = 0
        self.weights = np.full(m, 1 / m)
        self.cloud = np.zeros((m, 3))
        self.n_dof = 2 if parameters.planar else 3

    def step(self, odometry: np.ndarray, observations: Observations) -> None:
        settings = self.parameters
        poses = np.array([p.pose for p in self.particles])
        ratios = np.ones(len(poses))
        sigma = settings.motion.standard_deviations(odometry)
        if settings.proposal == "informed" and len(observations) and sigma.any():
            draws = self.rng.standard_normal(poses.shape)
            for m, (particle, draw) in enumerate(zip(self.particles, draws, strict=True)):
                poses[m], ratios[m] = self.informed(particle, odometry, observations, draw)
        else:
            poses = sample_motion(
                poses, odometry, settings.motion.standard_deviations(odometry), self.rng
            )
        for particle, pose, ratio in zip(self.particles, poses, ratios, strict=True):
            particle.pose = pose
            particle.path.append(pose)
            particle.weight *= self.take_in(particle, observations) * ratio
        self.n_observations += len(observations)
        self.weights = np.array([p.weight for p in self.particles])
        self.weights /= self.weights.sum()
        for particle, weight in zip(self.particles, self.weights, strict=True):
            particle.weight = weight
        self.cloud = poses
        self.best = self.particles[int(np.argmax(self.weights))].copied()
        if 1 / np.sum(self.weights**2) <= settings.resample_fraction * len(poses):
            ancestors = systematic_ancestors(np.log(self.weights), self.rng)
            self.particles = [self.particles[a].copied() for a in ancestors]
            for particle in self.particles:
                particle.weight = 1 / len(poses)

    def informed(self, particle, odometry, observations, draw) -> tuple[np.ndarray, float]:
        """Sample a pose from the informed proposal, with the ratio of eq. 3 to its density.

        Everything in the map frame; derivatives by differences.
        """
        n, gate = self.n_dof, self.parameters.gate
        sigma = self.parameters.motion.standard_deviations(odometry)
        before, particle.pose = particle.pose, compose(particle.pose, odometry)
        turn = rotation_about_z(particle.pose[2])[:n, :n]

        def place(k: int, eta: np.ndarray) -> np.ndarray:
            """Return the observed point after disturbances eta (..., 3)."""
            pose = compose(before, odometry + sigma * eta)
            point = rotation_about_z(pose[..., 2]) @ observations.position_m[k]
            point[..., :2] += pose[..., :2]
            return point[..., :n]

        def slope(k: int, eta: np.ndarray) -> np.ndarray:
            h = 1e-6 * np.eye(3)
            return (place(k, eta + h) - place(k, eta - h)).T / 2e-6

        widening = []
        for k in range(len(observations)):
            J = turn.T @ slope(k, np.zeros(3))
            widening.append(J @ J.T)
        chosen = self.associate(particle, observations, widening)
        eta = np.zeros(3)
        for _ in range(3):
            normal, right = np.eye(3), -eta
            for k, number in enumerate(chosen):
                if number is None or number == "drop":
                    continue
                landmark = particle.landmarks[number]
                R = self.observation(observations, k)[1]
                Z = landmark.covariance + turn @ R @ turn.T
                difference = place(k, eta) - landmark.mean
                J = slope(k, eta)
                weight = 1 / (1 + difference @ np.linalg.solve(Z, difference) / gate)
                normal = normal + weight * J.T @ np.linalg.solve(Z, J)
                right = right - weight * J.T @ np.linalg.solve(Z, difference)
            eta = eta + np.linalg.solve(normal, right)
        drawn = eta + np.linalg.solve(np.linalg.cholesky(normal).T, draw)
        prior = multivariate_normal(np.zeros(3), np.eye(3)).pdf(drawn)
        ratio = prior / multivariate_normal(eta, np.linalg.inv(normal)).pdf(drawn)
        return compose(before, odometry + sigma * drawn), ratio

    def take_in(self, particle: Particle, observations: Observations) -> float:
        """Update the particle's landmarks and return the likelihood of the frame (eq. 10)."""
        chosen = self.associate(particle, observations)
        likelihood = 1.0
        for k in range(len(observations)):
            z, R = self.observation(observations, k)
            if chosen[k] is None or chosen[k] == "drop":
                at_gate = self.density(self.parameters.gate, 2 * R)
                given = self.parameters.log_new_landmark_density
                likelihood *= at_gate if given is None else np.exp(given)
            else:
                landmark = particle.landmarks[chosen[k]]
                difference, Z, G = self.expectation(particle, landmark, z, R)
                distance = difference @ np.linalg.solve(Z, difference)
                likelihood *= self.density(distance, Z)
                K = landmark.covariance @ G.T @ np.linalg.inv(Z)  # eq. 7
                landmark.mean = landmark.mean + K @ difference  # eq. 8
                identity = np.eye(len(landmark.mean))
                landmark.covariance = (identity - K @ G) @ landmark.covariance  # eq. 9
                landmark.count += 1
            if chosen[k] == "drop":
                particle.associations.append(-1)
                continue
            number = self.n_observations + k if chosen[k] is None else chosen[k]
            particle.associations.append(number)
            if chosen[k] is None:
                rotation = rotation_about_z(particle.pose[2])[: self.n_dof, : self.n_dof]
                mean = transform_points(particle.pose, observations.position_m[[k]])[0]
                descriptor = observations.descriptor
                label = observations.label
                particle.landmarks[number] = Landmark(
                    mean[: self.n_dof],
                    rotation @ R @ rotation.T,
                    1,
                    number,
                    None if descriptor is None else descriptor[k],
                    None if label is None else int(label[k]),
                )
        return likelihood

    def associate(
        self, particle: Particle, observations: Observations, widening: list | None = None
    ) -> list:
        candidates = []
        gate = self.parameters.gate
        for k in range(len(observations)):
            z, R = self.observation(observations, k)
            for number, landmark in particle.landmarks.items():
                apart = self.unlikeness(landmark, observations, k)
                if apart is None:
                    continue
                difference, Z, _ = self.expectation(particle, landmark, z, R)
                if widening is not None:
                    Z = Z + widening[k]
                distance = difference @ np.linalg.solve(Z, difference)
                if distance <= gate:
                    by_distance = self.parameters.association == "gate"
                    candidates.append((distance if by_distance else apart, k, number))
        chosen: list = [None] * len(observations)
        for _, k, number in sorted(candidates):
            if chosen[k] is None and number not in chosen:
                chosen[k] = number
        if self.parameters.association == "label":
            named = {landmark.label for landmark in particle.landmarks.values()}
            for k in range(len(observations)):
                if chosen[k] is None and int(observations.label[k]) in named:
                    chosen[k] = "drop"
                named.add(int(observations.label[k]))
        return chosen

    def unlikeness(self, landmark, observations: Observations, k: int) -> float | None:
        """Return the descriptor distance; None if the two cannot match."""
        if self.parameters.association == "label":
            return 0.0 if landmark.label == observations.label[k] else None
        if self.parameters.association == "descriptor":
            apart = np.linalg.norm(landmark.descriptor - observations.descriptor[k])
            return apart if apart < self.parameters.descriptor_threshold else None
        return 0.0

    def observation(self, observations: Observations, k: int) -> tuple[np.ndarray, np.ndarray]:
        n = self.n_dof
        R = observations.covariance_m2[k][:n, :n]
        R = R + self.parameters.noise_floor_m**2 * np.eye(n)
        return observations.position_m[k][:n], R

    def expectation(self, particle, landmark, z, R):
        """Return innovation, Z and G in the robot frame (eq. 4-6)."""
        G = rotation_about_z(particle.pose[2]).T[: self.n_dof, : self.n_dof]
        place = np.array([*particle.pose[:2], 0.0])[: self.n_dof]
        return z - G @ (landmark.mean - place), G @ landmark.covariance @ G.T + R, G

    @staticmethod
    def density(distance: float, Z: np.ndarray) -> float:
        return np.exp(-distance / 2) / np.sqrt(np.linalg.det(2 * np.pi * Z))

    def best_landmarks(self, min_count: int = 1) -> list[Landmark]:
        kept = [m for m in self.best.landmarks.values() if m.count >= min_count]
        return sorted(kept, key=lambda landmark: landmark.source)
