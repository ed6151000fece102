"""Maps far from their origins, of different heights, tilted, in other units, or the same twice."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.align.aligners import ALIGNERS, make_aligner
from mapfusion.align.alignment import Pairs, Status
from mapfusion.align.correspondences import MatchParameters, match
from mapfusion.align.frames import (
    Overlap,
    height_difference,
    height_offset_m,
    in_local_frame,
    level_heights,
    moved_motion,
    origin_of,
)
from mapfusion.align.refinement import Refinement
from mapfusion.errors import InputError
from mapfusion.files import write_atomically
from mapfusion.fusion.fusers import COMPARED, AlignedPair, make_fuser
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import chi_square_bound
from mapfusion.landmark_map import LandmarkMap, read_map
from mapfusion.verification.false_alarms import Acceptance
from mapfusion.verification.registration import Registered, Registration
from mapfusion.verification.rivals import other_unit
from tests.mapfusion.align.map_pairs import landmarks, unit_vectors

SIGMA_M = 0.02
T_A_B = np.array([2.0, -1.0, 0.4])
UTM = np.array([465000.0, 5250000.0])
far = st.tuples(st.floats(2e3, 6e6), st.floats(-6e6, 6e6))


def two_maps(n: int = 40, seed: int = 0, planar: bool = False) -> tuple[LandmarkMap, LandmarkMap]:
    """Two maps of n landmarks with descriptors."""
    rng = np.random.default_rng(seed)
    world, looks = rng.uniform([-6, -6, 0.2], [6, 6, 1.5], (n, 3)), unit_vectors(rng, n)
    maps = []
    for name, T in (("a", np.zeros(3)), ("b", T_A_B)):
        p = se2.transform_points(se2.inverse(T), world) + rng.normal(0, SIGMA_M, (n, 3))
        if planar:
            p[:, 2] = 0.0
        seen = looks + rng.normal(0, 0.01, looks.shape).astype(np.float32)
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        maps.append(landmarks(p, SIGMA_M, seen, planar=planar, name=name))
    return maps[0], maps[1]


def moved(landmark_map: LandmarkMap, x: float, y: float, z: float = 0.0) -> LandmarkMap:
    return replace(landmark_map, position_m=landmark_map.position_m + np.array([x, y, z]))


def registered(a: LandmarkMap, b: LandmarkMap, name: str = "clique") -> Registered:
    registration = Registration(make_aligner(name))
    return registration.register(a, b, match(a, b), np.random.default_rng(0))


def merged(a: LandmarkMap, b: LandmarkMap, found: Registered, fuser: str = "joint"):
    pair = AlignedPair(0, 1, found.applied, match(a, b), found.verdict.log10_false_alarms)
    return merge([a, b], [pair], fuser=make_fuser(fuser)).fused[0]


@pytest.mark.parametrize("name", ALIGNERS)
@settings(max_examples=4, deadline=None)
@given(shift_a=far, shift_b=far)
def test_a_shift_of_the_frames_shifts_the_answer(name, shift_a, shift_b) -> None:
    a, b = two_maps()
    near, found = (
        registered(a, b, name),
        registered(moved(a, *shift_a), moved(b, *shift_b), name),
    )
    assert found.verdict.status is near.verdict.status is Status.ACCEPTED
    assert np.array_equal(found.refined.inlier, near.refined.inlier)
    own, its = found.refined.overlap, near.refined.overlap
    assert own is not None
    assert its is not None
    back = own.moved(-np.array(shift_a), -np.array(shift_b))
    assert np.allclose(back.p_a, its.p_a, atol=1e-6, rtol=0)
    assert back.theta_rad == pytest.approx(its.theta_rad, abs=1e-9)
    scale = np.sqrt(np.outer(np.diag(its.covariance), np.diag(its.covariance)))
    assert np.abs((back.covariance - its.covariance) / scale).max() < 1e-6
    # at the origins: t = s_a + t_near - R s_b
    T, _ = moved_motion(
        np.append(near.refined.T_a_b[:2], own.theta_rad),
        np.zeros((3, 3)),
        np.array(shift_a),
        np.array(shift_b),
    )
    assert np.allclose(found.refined.T_a_b, T, atol=1e-3, rtol=0)


@pytest.mark.parametrize("fuser", COMPARED)
@settings(max_examples=4, deadline=None)
@given(shift_a=far, shift_b=far)
def test_fused_maps_follow_a_shift_of_the_frames(fuser, shift_a, shift_b) -> None:
    a, b = two_maps()
    # covariance intersection has no unique weight for equal covariances
    factor = np.random.default_rng(1).uniform(0.5, 2.0, (len(b), 1, 1))
    b = replace(b, covariance_m2=b.covariance_m2 * factor)
    far_a, far_b = moved(a, *shift_a), moved(b, *shift_b)
    near = merged(a, b, registered(a, b), fuser)
    found = merged(far_a, far_b, registered(far_a, far_b), fuser)
    assert np.array_equal(found.parents, near.parents)
    off_m = found.landmarks.position_m - near.landmarks.position_m - np.array([*shift_a, 0])
    assert np.abs(off_m).max() < 1e-6
    S = near.landmarks.covariance_m2
    assert np.abs(found.landmarks.covariance_m2 - S).max() < 1e-6 * S.max()
    assert found.middle_covariance is not None
    assert near.middle_covariance is not None
    size = np.abs(near.middle_covariance[1]).max()
    assert np.abs(found.middle_covariance[1] - near.middle_covariance[1]).max() < 1e-6 * size


def test_maps_near_their_origin_stay_as_they_are() -> None:
    a, _ = two_maps()
    assert not origin_of(a).any()
    assert not origin_of(moved(a, 100, -100)).any()
    assert in_local_frame(a, origin_of(a)) is a


def test_the_shift_to_a_local_frame_is_exact() -> None:
    a, _ = two_maps()
    there = moved(a, *UTM)
    origin = origin_of(there)
    assert np.hypot(*(origin - UTM)) < 10
    local = in_local_frame(there, origin)
    assert np.array_equal(local.position_m[:, :2] + origin, there.position_m[:, :2])
    assert np.array_equal(in_local_frame(local, -origin).position_m, there.position_m)


def test_moved_covariance_is_that_of_moved_samples() -> None:
    S = np.array([[4e-4, 1e-4, 2e-5], [1e-4, 3e-4, -1e-5], [2e-5, -1e-5, 1e-5]])
    origins = np.array([30.0, -20.0]), np.array([10.0, 50.0])
    T, moved_S = moved_motion(T_A_B, S, *origins)
    step, numbers = 1e-6, []
    for axis in np.eye(3):
        ends = [moved_motion(T_A_B + sign * step * axis, S, *origins)[0] for sign in (1, -1)]
        numbers.append((ends[0] - ends[1]) / (2 * step))
    J = np.array(numbers).T
    assert np.allclose(moved_S, J @ S @ J.T, rtol=1e-6)
    p = np.array([1.0, 2.0])
    by_points = se2.transform_points(T, p + origins[1])
    assert np.allclose(by_points, se2.transform_points(T_A_B, p) + origins[0])
    again = moved_motion(T, moved_S, *(-origin for origin in origins))
    assert np.allclose(again[0], T_A_B)
    assert np.allclose(again[1], S, atol=1e-12)


def test_the_overlap_gives_the_motion_back() -> None:
    S = np.diag([1e-4, 2e-4, 1e-6])
    overlap = Overlap.of(T_A_B, S, np.array([[5.0, 1.0], [7.0, 3.0]]))
    T, covariance = overlap.motion(np.zeros(2), np.zeros(2))
    assert np.allclose(T, T_A_B)
    assert np.allclose(covariance, S)


@pytest.mark.parametrize("height_m", [1.0, -3.0, 0.3])
def test_a_known_height_difference_is_found_and_removed(height_m: float) -> None:
    a, b = two_maps()
    higher = moved(b, 0, 0, height_m)
    near, found = registered(a, b), registered(a, higher)
    heights = found.refined.heights
    assert found.verdict.accepted
    assert heights is not None
    assert abs(heights.used_offset_m - height_m) < 4 * heights.sigma_m < 0.03
    assert np.allclose(found.refined.T_a_b, near.refined.T_a_b, atol=1e-6)
    assert f"b is {abs(heights.offset_m):.3f} m" in found.verdict.reason
    fused, level = merged(a, higher, found), merged(a, b, near)
    assert fused.height_m is not None
    assert fused.height_m[1] == pytest.approx(-heights.offset_m)
    assert len(fused.landmarks) == len(level.landmarks) == 40
    off_m = fused.landmarks.position_m[:, 2] - level.landmarks.position_m[:, 2]
    assert np.abs(off_m).max() < 0.02


def test_equal_heights_are_not_taken_for_an_offset() -> None:
    """The rate of false offsets is that of the stated probability."""
    rng, variance, n_false = np.random.default_rng(0), np.full(60, 2 * SIGMA_M**2), 0
    for _ in range(500):
        up = np.where(np.arange(60) < 20, rng.normal(0, SIGMA_M * 2**0.5, 60), 0.0)
        up[20:] = rng.uniform(0, 1.5, 40) - rng.uniform(0, 1.5, 40)  # false pairs
        n_false += height_offset_m(up, variance, chi_square_bound(0.999, 1)) != 0
    assert n_false <= 3


def test_heights_of_a_chain_of_maps_agree_with_all_offsets() -> None:
    robots = np.array([(0, 1), (1, 2), (0, 2)])
    found = level_heights(3, robots, np.array([1.0, 2.0, 3.0]), np.ones(3))
    assert np.allclose(np.diff(found), [1.0, 2.0])


@pytest.mark.parametrize("degrees", [2.0, 3.0, 6.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_tilt_is_named_and_not_merged(degrees: float, seed: int) -> None:
    a, b = two_maps(60, seed)
    angle = math.radians(degrees)
    turn = np.array(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    )
    tilted = replace(b, position_m=b.position_m @ turn.T)
    found = registered(a, tilted)
    heights = found.refined.heights
    assert heights is not None
    assert heights.is_tilted
    assert math.degrees(heights.tilt_rad) == pytest.approx(degrees, abs=0.3)
    assert "b is tilted by" in found.verdict.reason
    # a smaller tilt is named, and leaves most pairs within the test of heights
    assert degrees < 3 or not found.verdict.accepted


def test_level_maps_are_rarely_called_tilted() -> None:
    n_tilted = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        p_a = rng.uniform([-6, -6, 0], [6, 6, 1.5], (30, 3))
        p_b = p_a + rng.normal(0, SIGMA_M * 2**0.5, p_a.shape)
        variance, each = np.full(30, 2 * SIGMA_M**2), np.ones(30, dtype=bool)
        found = height_difference(p_a, p_b, variance, chi_square_bound(0.999, 1), each)
        assert found is not None
        n_tilted += found.is_tilted
    assert n_tilted <= 1


def test_one_landmark_without_a_place_is_left_aside() -> None:
    a, b = two_maps()
    covariance = a.covariance_m2.copy()
    covariance[7] = 1e10 * np.eye(3)
    wide = replace(a, covariance_m2=covariance)
    pairs = match(wide, b)
    assert 7 not in pairs.index_a
    assert len(pairs) == 39
    found = registered(wide, b)
    assert found.verdict.accepted
    assert "1 landmark of a left aside" in found.verdict.reason


def test_shared_observations_are_named() -> None:
    a, b = two_maps()
    assert a.descriptor is not None
    assert b.descriptor is not None
    assert "same" not in registered(a, b).verdict.reason
    looks = b.descriptor.copy()
    looks[:15] = a.descriptor[:15]
    told = registered(a, replace(b, descriptor=looks)).verdict.reason
    assert "15 of 40 pairs are the same observations in a and b" in told
    assert "are the same map" in registered(a, replace(a, name="b")).verdict.reason


def test_two_maps_in_millimetres_are_named() -> None:
    a, b = two_maps()
    large_a, large_b = (
        replace(m, position_m=1000 * m.position_m, covariance_m2=1e6 * m.covariance_m2)
        for m in (a, b)
    )
    assert unit_of(large_a, large_b) == ("millimetres", (True, True))
    assert unit_of(a, b) == ("", (False, False))


@pytest.mark.parametrize(
    ("unit", "size_m"), [("millimetres", 1e-3), ("feet", 0.3048), ("inches", 0.0254)]
)
def test_one_map_in_another_unit_is_named_without_descriptors(unit: str, size_m: float) -> None:
    a, b = (replace(each, descriptor=None, label=None) for each in two_maps())
    large_b = replace(b, position_m=b.position_m / size_m)
    assert unit_of(a, large_b) == (unit, (False, True))
    assert unit_of(large_b, a) == (unit, (True, False))
    other = replace(b, position_m=np.random.default_rng(0).uniform(0, 40 / size_m, (len(b), 3)))
    assert unit_of(a, other) == ("", (False, False))


def unit_of(a: LandmarkMap, b: LandmarkMap) -> tuple[str, tuple[bool, bool]]:
    pairs = Pairs(a, b, match(a, b))
    return other_unit(pairs, Acceptance(), Refinement(), MatchParameters())


def test_maps_without_landmarks_are_in_no_unit() -> None:
    a, _ = two_maps()
    none = a[np.zeros(0, np.int64)]
    assert unit_of(none, a) == unit_of(a, none) == unit_of(none, none) == ("", (False, False))


def test_a_tilt_is_named_without_descriptors() -> None:
    a, b = (replace(each, descriptor=None, label=None) for each in two_maps(80))
    level = registered(a, b)
    assert level.verdict.accepted
    assert level.refined.heights is not None
    assert not level.refined.heights.is_tilted
    tilt_rad = math.radians(3)
    p = b.position_m.copy()
    p[:, 2] += math.tan(tilt_rad) * p[:, 0]
    found = registered(a, replace(b, position_m=p))
    assert not found.verdict.accepted
    assert found.refined.heights is not None
    assert found.refined.heights.tilt_rad == pytest.approx(tilt_rad, abs=math.radians(0.3))
    assert "b is tilted by" in found.verdict.reason


def test_a_map_that_holds_the_other_is_named_without_descriptors() -> None:
    a, b = (replace(each, descriptor=None, label=None) for each in two_maps())
    assert "same observations" not in registered(a, b).verdict.reason
    fused = b.position_m.copy()
    fused[:10] = se2.transform_points(se2.inverse(T_A_B), a.position_m[:10])
    told = registered(a, replace(b, position_m=fused)).verdict.reason
    assert "10 of 31 pairs are the same observations in a and b" in told


def test_a_map_without_covariances_needs_a_stated_sigma(tmp_path) -> None:
    path = tmp_path / "a.csv"
    write_atomically(path, lambda file: file.write_text("x_m,y_m,z_m,label\n1,2,3,0\n4,5,6,1\n"))
    with pytest.raises(InputError, match=r"has no column cov_xx_m2.*--sigma 0.05"):
        read_map(path)
    found = read_map(path, sigma_m=0.05)
    assert np.allclose(found.covariance_m2, 0.05**2 * np.eye(3))
    assert not found.planar
