import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fastslam.landmark_arrays import Estimates
from mapfusion.fastslam.measurement import (
    MapObservations,
    innovation,
    log_density_at_gate,
    observations_in_map,
    quadratic_form,
)
from mapfusion.geometry.se2 import rotation_about_z, transform_points

UPPER = np.triu_indices(3)


def covariances(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.normal(size=(n, 3, 3)) * 10.0 ** rng.uniform(-2, 0, (n, 1, 3))
    return root @ np.swapaxes(root, 1, 2) + 1e-4 * np.eye(3)


@pytest.mark.parametrize("planar", [False, True])
def test_sightings_are_the_observations_in_each_particles_map(planar):
    rng = np.random.default_rng(0)
    poses, position = rng.normal(size=(4, 3)), rng.normal(size=(6, 3))
    covariance = covariances(rng, 6)
    seen = observations_in_map(poses, position, covariance, planar)
    n = 2 if planar else 3
    for m, pose in enumerate(poses):
        turn = rotation_about_z(pose[2])
        np.testing.assert_allclose(
            seen.point_m[:, m, :n], transform_points(pose, position)[:, :n], atol=1e-12
        )
        expected = turn @ covariance @ turn.T
        if planar:
            expected[:, 2, :] = expected[:, :, 2] = 0
        np.testing.assert_allclose(
            seen.covariance_m2[:, m], expected[:, UPPER[0], UPPER[1]], atol=1e-12
        )


@pytest.mark.parametrize("planar", [False, True])
def test_innovation_gives_the_distance_and_determinant_of_the_matrix(planar):
    rng = np.random.default_rng(1)
    n = 2 if planar else 3
    point, mean = rng.normal(size=(2, 50, 3))
    noise, sigma = covariances(rng, 50), covariances(rng, 50)
    flat_noise, flat_sigma = (matrix[None, :, UPPER[0], UPPER[1]] for matrix in (noise, sigma))
    seen = MapObservations(point[None], flat_noise)
    own = Estimates(mean[None], flat_sigma, np.ones((1, 50), dtype=np.int32))
    for m in range(50):
        *form, determinant = innovation(seen, 0, own, 0, m, planar)
        Z = (noise[m] + sigma[m])[:n, :n]
        difference = (point[m] - mean[m])[:n]
        assert quadratic_form(*form) == pytest.approx(difference @ np.linalg.solve(Z, difference))
        assert determinant == pytest.approx(np.linalg.det(Z))


@pytest.mark.parametrize("planar", [False, True])
def test_what_matches_nothing_weighs_as_a_match_at_the_gate(planar):
    parameters = FastSlamParameters(planar=planar, gate_probability=0.95)
    n = 2 if planar else 3
    assert parameters.gate == pytest.approx(chi2.ppf(0.95, n))
    covariance = covariances(np.random.default_rng(2), 5)
    for R, log_density in zip(
        covariance, log_density_at_gate(covariance, parameters.gate, planar), strict=True
    ):
        Z = 2 * R[:n, :n]
        at_gate = np.linalg.cholesky(Z)[:, 0] * np.sqrt(parameters.gate)
        assert log_density == pytest.approx(multivariate_normal(cov=Z).logpdf(at_gate))
