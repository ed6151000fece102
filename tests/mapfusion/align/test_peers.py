"""Tests of the adapters for aligners of other packages."""

import numpy as np
import pytest

from mapfusion.align.aligners import as_aligner, make_aligner
from mapfusion.align.alignment import Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry import se2
from tests.mapfusion.align.map_pairs import error, given_pairs, landmarks, swapped

pytest.importorskip("kiss_matcher")

# KISS-Matcher keeps its first noise bound for as long as the process lives, so tests use one
PEERS = {"opencv": make_aligner("opencv"), "kiss_matcher": make_aligner("kiss_matcher")}


def estimate(name, pair, seed=0):
    maps = pair.map_a, pair.map_b, pair.correspondences
    return as_aligner(PEERS[name]).align(*maps, np.random.default_rng(seed))


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("name", PEERS)
def test_exact_without_noise(name, planar):
    pair = given_pairs(np.random.default_rng(0), 60, planar=planar)
    found = estimate(name, pair)
    assert (found.status, found.reason) == (Status.ACCEPTED, "")
    assert found.inlier.all()
    # KISS-Matcher takes its points in single precision
    assert error(found.T_a_b, pair.T_a_b) == pytest.approx((0, 0), abs=1e-5)


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("name", PEERS)
def test_false_pairs_are_left_out(name, planar):
    pair = given_pairs(np.random.default_rng(1), 300, 0.2, 0.05, planar=planar)
    found = estimate(name, pair)
    true = np.flatnonzero(pair.is_true)
    best = np.array(fit_rigid(pair.map_a.position_m, pair.map_b.position_m, true))
    assert error(found.T_a_b, best) == pytest.approx((0, 0), abs=0.05)
    assert found.inlier[pair.is_true].mean() > 0.9
    assert found.inlier[~pair.is_true].mean() < 0.05
    assert np.isfinite(found.covariance).all()
    assert -np.pi <= found.T_a_b[2] <= np.pi


@pytest.mark.parametrize("name", PEERS)
def test_exchanged_maps_give_the_inverse(name):
    pair = given_pairs(np.random.default_rng(2), 200, 0.5, 0.02)
    there, back = estimate(name, pair), estimate(name, swapped(pair))
    assert error(se2.inverse(back.T_a_b), there.T_a_b) == pytest.approx((0, 0), abs=0.02)


def test_opencv_gives_a_motion_although_it_fits_a_scale():
    rng = np.random.default_rng(3)
    p = rng.uniform(0, 20, (40, 3))
    grown = landmarks(1.01 * p)
    rows = np.arange(40)
    found = as_aligner(PEERS["opencv"]).align(
        grown, landmarks(p), Correspondences(rows, rows, np.zeros(40)), np.random.default_rng(0)
    )
    assert found.inlier.all()
    # the best motion brings the centroids together; 1 % of 10 m remain at the far corners
    assert found.T_a_b[:2] == pytest.approx(0.01 * p[:, :2].mean(axis=0), abs=1e-6)
    assert found.T_a_b[2] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("name", PEERS)
def test_the_generator_alone_decides(name):
    pair = given_pairs(np.random.default_rng(4), 500, 0.02, 0.05)
    found = [estimate(name, pair, seed).T_a_b for seed in (0, 1, 2, 3, 4, 0)]
    np.testing.assert_array_equal(found[0], found[-1])
    differ = any(not np.array_equal(found[0], T, equal_nan=True) for T in found)
    assert differ == PEERS[name].randomised


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("n", [0, 1, 2, 3])
@pytest.mark.parametrize("name", PEERS)
def test_too_few_pairs_are_a_status(name, n):
    pair = given_pairs(np.random.default_rng(5), 40)
    pair.correspondences.distance[:] = 0
    maps = pair.map_a, pair.map_b, pair.correspondences[np.arange(n)]
    found = as_aligner(PEERS[name]).align(*maps, np.random.default_rng(0))
    assert found.inlier.shape == (n,)
    assert (found.status is Status.ACCEPTED) == (n == 3)
    assert bool(found.reason) == (n < 3)


@pytest.mark.parametrize("name", PEERS)
def test_nothing_agrees(name):
    rng = np.random.default_rng(6)
    rows = np.arange(4)
    apart = landmarks(np.diag([1.0, 10.0, 0.0])[[0, 1, 2, 2]] + rng.uniform(0, 0.1, (4, 3)))
    wide = landmarks(np.diag([300.0, 900.0, 0.0])[[0, 1, 2, 2]] * [[1], [1], [1], [-4]] + 50.0)
    pairs = Correspondences(rows, rows, np.zeros(4))
    found = as_aligner(PEERS[name]).align(apart, wide, pairs, np.random.default_rng(0))
    assert found.status is not Status.ACCEPTED
    assert found.reason


@pytest.mark.parametrize(
    ("name", "parameters", "wrong"),
    [
        ("opencv", {"gate_m": 0}, "gate_m"),
        ("opencv", {"confidence": 1}, "confidence"),
        ("opencv", {"max_draws": 0}, "max_draws"),
        ("opencv", {"local_rounds": -1}, "local_rounds"),
        ("kiss_matcher", {"noise_bound_m": 0.001}, "noise_bound_m"),
        ("kiss_matcher", {"solver_share": 1.5}, "solver_share"),
        ("kiss_matcher", {"voxel": 1}, "voxel"),
    ],
)
def test_parameters_out_of_range_are_named(name, parameters, wrong):
    with pytest.raises(ValueError, match=wrong):
        make_aligner(name, **parameters)
