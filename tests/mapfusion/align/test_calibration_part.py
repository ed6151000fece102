"""What two cameras' calibrations leave open of an alignment, against solving it again."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.align.aligners import make_aligner
from mapfusion.align.alignment import Pairs
from mapfusion.align.drift import calibration_part
from mapfusion.align.refinement import Refinement
from mapfusion.fusion.fused_map import AlignedPair
from mapfusion.fusion.fusers import make_fuser
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from mapfusion.geometry.camera import EXACT, CalibrationError
from mapfusion.landmark_map import LandmarkMap
from mapfusion.registration import Registration
from tests.mapfusion.align.map_pairs import MapPair, given_pairs, stretched

OF_A, OF_B = CalibrationError(0.002, 0.003), CalibrationError(0.001, 0.004)


@pytest.fixture(scope="module")
def pair() -> MapPair:
    rng = np.random.default_rng(3)
    found = given_pairs(rng, 60, sigma_m=0.02)
    map_a = replace(found.map_a, covariance_m2=found.map_b.covariance_m2)
    return replace(found, map_a=stretched(rng, map_a), map_b=stretched(rng, found.map_b))


def with_errors(pair: MapPair, of_a: CalibrationError, of_b: CalibrationError) -> MapPair:
    made = replace(pair.map_a, calibration=of_a), replace(pair.map_b, calibration=of_b)
    return replace(pair, map_a=made[0], map_b=made[1])


def refined(pair: MapPair):
    pairs = Pairs(pair.map_a, pair.map_b, pair.correspondences)
    return Refinement(least_drift_m=0.0).refine(pairs, pair.T_a_b)


def spoiled(landmarks: LandmarkMap, row: int, by: CalibrationError, share: float) -> LandmarkMap:
    moved = landmarks.position_m + share * by.moves_m(landmarks.position_m)[:, row]
    return replace(landmarks, position_m=moved)


@pytest.mark.parametrize("camera", ["", "one"])
def test_equals_solving_again_with_spoiled_maps(pair: MapPair, camera: str) -> None:
    """Each error a hundredth of its sigma; the refinement knows nothing of them."""
    share, columns = 0.01, []
    of_both = {"map_a": replace(OF_A, camera=camera), "map_b": replace(OF_B, camera=camera)}
    together = [["map_a", "map_b"]] if camera else [["map_a"], ["map_b"]]
    for row in (0, 1):
        for names in together:
            ends = []
            for s in (share, -share):
                parts = {n: spoiled(getattr(pair, n), row, of_both[n], s) for n in names}
                ends.append(refined(replace(pair, **parts)).T_a_b)
            columns.append((ends[0] - ends[1]) / (2 * share))
    by = np.array(columns).T
    before, after = refined(pair), refined(with_errors(pair, *of_both.values()))
    added = after.covariance - before.covariance
    sigma = np.sqrt(np.diag(by @ by.T))
    # which pairs are true, and s_drift, are judged anew by whoever solves again
    np.testing.assert_allclose((added - by @ by.T) / np.outer(sigma, sigma), 0, atol=0.03)
    np.testing.assert_array_equal(before.T_a_b, after.T_a_b)


def test_headings_alone_turn_one_map_about_either_beginning(pair: MapPair) -> None:
    a, b = CalibrationError(0.002), CalibrationError(0.001)
    own = with_errors(pair, a, b)
    found = calibration_part(pair.T_a_b, Pairs(own.map_a, own.map_b, own.correspondences), 0.1)
    x, y, _ = pair.T_a_b
    by = np.array([[-y, x, 1.0], [0.0, 0.0, -1.0]]).T * [0.002, 0.001]
    # the maps' noise leaves residuals, which turn with neither
    np.testing.assert_allclose(found, by @ by.T, atol=2e-3 * 0.002**2 * (1 + x * x + y * y))


def test_fused_motions_are_no_surer_than_the_cameras(pair: MapPair) -> None:
    """The joint fuser's, too: nothing tells whose heading is off; common extent tells the scale."""
    a, b = CalibrationError(0.01), CalibrationError(0.02)

    def motion_covariance(pair: MapPair) -> np.ndarray:
        maps, c = (pair.map_a, pair.map_b), pair.correspondences
        aligned = Registration(make_aligner("ransac"), judge=None).on(*maps, c)
        found = aligned.register(np.random.default_rng(0)).refined
        fused = merge(maps, [AlignedPair(0, 1, found, c)], fuser=make_fuser()).fused[0]
        return fused.motion_covariance[1]

    added = motion_covariance(with_errors(pair, a, b)) - motion_covariance(pair)
    assert added[2, 2] == pytest.approx(0.01**2 + 0.02**2, rel=0.02)
    only_scale = motion_covariance(with_errors(pair, CalibrationError(0, 0.1), EXACT))
    least, most = np.linalg.eigvalsh(only_scale)[[0, -1]]
    assert 0 < least < most < 0.05**2  # a tenth of 10 m would be a metre


def test_inverse_alignments_are_equally_sure(pair: MapPair) -> None:
    own = with_errors(pair, OF_A, OF_B)
    there = calibration_part(pair.T_a_b, Pairs(own.map_a, own.map_b, own.correspondences), 1.0)
    c = own.correspondences
    turned = type(c)(c.index_b, c.index_a, c.distance)
    T = se2.inverse(pair.T_a_b)
    back = calibration_part(T, Pairs(own.map_b, own.map_a, turned), 1.0)
    cos, sin = np.cos(T[2]), np.sin(T[2])
    J = np.array([[-cos, sin, T[1]], [-sin, -cos, -T[0]], [0, 0, -1]])  # d inverse / dT
    sigma = np.sqrt(np.diag(back))
    np.testing.assert_allclose((back - J @ there @ J.T) / np.outer(sigma, sigma), 0, atol=0.01)
