from dataclasses import replace

import numpy as np
import pytest

from mapfusion.align import correspondences as module
from mapfusion.align.correspondences import (
    Correspondences,
    HeightGate,
    MatchParameters,
    match,
    scale_note,
)
from mapfusion.descriptors import USURF
from mapfusion.tables import NO_LABEL
from tests.mapfusion.align.map_pairs import landmarks, unit_vectors


def two_maps(rng, n=120, noise=0.03):
    descriptor = unit_vectors(rng, n)
    p = rng.uniform(0, 3, (n, 3))
    order = rng.permutation(n)
    other = descriptor[order] + rng.normal(0, noise, (n, 64)).astype(np.float32)
    maps = landmarks(p, descriptor=descriptor), landmarks(p[order], descriptor=other)
    return *(replace(each, descriptor_kind=USURF) for each in maps), order


def slow_match(a, b, parameters):
    """Return pairs by definition: mutually nearest among landmarks of compatible height."""
    distance = np.full((len(a), len(b)), np.inf)
    for i in range(len(a)):
        for j in range(len(b)):
            variance = a.covariance_m2[i, 2, 2] + b.covariance_m2[j, 2, 2]
            sigma = np.sqrt(variance + parameters.height.floor_m**2)
            if abs(a.position_m[i, 2] - b.position_m[j, 2]) <= 3.2905 * sigma:  # 0.999
                distance[i, j] = np.linalg.norm(a.descriptor[i] - b.descriptor[j])
    return {
        (i, j)
        for i, j in enumerate(distance.argmin(axis=1))
        if distance[:, j].argmin() == i and distance[i, j] <= parameters.max_descriptor_distance
    }


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.2])
def test_pairs_are_those_of_the_definition(noise, monkeypatch):
    monkeypatch.setattr(module, "_BLOCK_ROWS", 50)  # so that pairs lie in different blocks
    a, b, _ = two_maps(np.random.default_rng(0), noise=noise)
    parameters = MatchParameters(max_descriptor_distance=max(0.9, 8 * noise))
    found = match(a, b, parameters)
    assert set(zip(found.index_a, found.index_b, strict=True)) == slow_match(a, b, parameters)
    assert len(found) > 20
    expected = np.linalg.norm(a.descriptor[found.index_a] - b.descriptor[found.index_b], axis=1)
    np.testing.assert_allclose(found.distance, expected, atol=1e-3)


def test_heights_of_all_certainties_a_kilometre_up(monkeypatch):
    """Height deviations range from 1 mm to 1 m; blocks of similar height lose no pair."""
    monkeypatch.setattr(module, "_BLOCK_ROWS", 16)
    rng = np.random.default_rng(5)
    maps = []
    for landmarks_of in two_maps(rng, 150)[:2]:
        covariance = landmarks_of.covariance_m2.copy()
        covariance[:, 2, 2] = 10 ** rng.uniform(-6, 0, 150)
        up = landmarks_of.position_m.copy()
        up[:, 2] += 1000 + rng.normal(0, 0.1, 150)
        maps.append(replace(landmarks_of, position_m=up, covariance_m2=covariance))
    parameters = MatchParameters(2.0, HeightGate(0.999, floor_m=0.0))
    found = match(*maps, parameters)
    assert set(zip(found.index_a, found.index_b, strict=True)) == slow_match(*maps, parameters)
    assert 50 < len(found) < 140


def test_of_equally_near_ones_the_first_is_taken():
    p, descriptor = np.zeros((3, 3)), np.eye(3, 64)[[0, 0, 1]]
    a, b = landmarks(p, descriptor=descriptor), landmarks(p[:2], descriptor=descriptor[:2])
    found = match(a, b)
    assert set(zip(found.index_a, found.index_b, strict=True)) == {(0, 0)}


@pytest.mark.parametrize("floor_m", [0.0, 0.035])
def test_planar_maps_without_variance_of_heights(floor_m):
    a, b, _ = two_maps(np.random.default_rng(6))
    flat = [replace(m, planar=True, covariance_m2=0 * m.covariance_m2) for m in (a, b)]
    found = match(*flat, MatchParameters(0.5, HeightGate(floor_m=floor_m)))
    assert len(found) == len(a)


def test_true_pairs_are_found():
    a, b, order = two_maps(np.random.default_rng(1))
    found = match(a, b, MatchParameters(max_descriptor_distance=0.5))
    np.testing.assert_array_equal(found.index_a, order[found.index_b])
    assert len(found) == len(a)


def test_heights_decide_unless_planar():
    a, b, _ = two_maps(np.random.default_rng(2))
    lifted = replace(b, position_m=b.position_m + np.array([0, 0, 10.0]))
    parameters = MatchParameters(max_descriptor_distance=0.5)
    assert len(match(a, lifted, parameters, one_floor=True)) == 0
    assert len(match(a, lifted, parameters)) == len(a)
    flat = [replace(m, planar=True) for m in (a, lifted)]
    assert len(match(*flat, parameters)) == len(a)


def test_height_gate_keeps_the_share_it_promises():
    rng = np.random.default_rng(3)
    gate = HeightGate(probability=0.9, floor_m=0.03)
    z_a, z_b, repeated = rng.normal(0, [[0.05], [0.02], [0.03]], (3, 100_000))
    kept = gate.agrees(z_a + repeated, np.float64(0.05**2), z_b, np.float64(0.02**2))
    assert kept.mean() == pytest.approx(0.9, abs=0.005)


def test_labels_win_and_the_most_observed_of_one_label_is_taken():
    a = landmarks(np.zeros((4, 3)), label=np.array([7, -1, 3, 7], np.int32))
    a = replace(a, count=np.array([2, 9, 5, 6], np.int32), descriptor=np.eye(4, 64))
    b = landmarks(np.zeros((3, 3)), label=np.array([3, 7, -1], np.int32))
    b = replace(b, descriptor=np.eye(3, 64))
    found = match(a, b)
    assert set(zip(found.index_a, found.index_b, strict=True)) == {(3, 1), (2, 0)}


def test_landmark_without_descriptor_matches_nothing():
    a, b, order = two_maps(np.random.default_rng(4), n=30)
    a.descriptor[5] = np.nan
    b.descriptor[6] = np.nan
    found = match(a, b, MatchParameters(max_descriptor_distance=0.5))
    assert not np.isin(5, found.index_a)
    assert not np.isin(6, found.index_b)
    assert len(found) == 30 - len({5, order[6]})


@pytest.mark.parametrize("n", [0, 5])
def test_nothing_to_match_by(n):
    bare = landmarks(np.zeros((n, 3)))
    described = landmarks(np.zeros((3, 3)), descriptor=np.eye(3, 64))
    for pair in ((bare, described), (described, bare), (bare, bare)):
        assert len(match(*pair)) == 0


def test_wrong_arguments_are_named():
    index = np.arange(3)
    with pytest.raises(ValueError, match="index_b"):
        Correspondences(index, index[:2], np.zeros(3))
    with pytest.raises(ValueError, match="index_a"):
        Correspondences(index.astype(float), index, np.zeros(3))
    with pytest.raises(ValueError, match="distance"):
        Correspondences(index, index, np.array([0, np.nan, 0]))
    with pytest.raises(ValueError, match="max_descriptor_distance"):
        MatchParameters(max_descriptor_distance=float("nan"))
    with pytest.raises(ValueError, match="probability"):
        HeightGate(probability=1.0)
    with pytest.raises(ValueError, match="floor_m"):
        HeightGate(floor_m=-1.0)


def test_heights_of_one_point_agree_as_often_as_stated():
    """Height variances and track offsets of 4 mm together explain the height differences."""
    rng, n, sigma_m = np.random.default_rng(0), 200_000, 0.003
    z_a, z_b = rng.normal(0, sigma_m, (2, n)) + rng.normal(0, 0.004, (2, n))
    variance = np.full(n, sigma_m**2)
    off = np.mean(~HeightGate().agrees(z_a, variance, z_b, variance))
    assert off == pytest.approx(0.001, rel=0.25)  # 200 of them: 3.5 standard deviations


def unlike_maps(rng, n=40):
    """Return two maps of the same landmarks, the second moved in plan, with unit descriptors."""
    descriptor, p = unit_vectors(rng, n), rng.uniform(-6, 6, (n, 3)) * [1, 1, 0.1]
    moved = p @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + [2.0, 5.0, 0.0]
    return landmarks(p, descriptor=descriptor), landmarks(moved, descriptor=descriptor)


def told_apart(a, b, one_floor=False, **parameters):
    found = match(a, b, MatchParameters(**parameters), one_floor)
    assert len(found) < 3
    return found.shortage


def test_the_test_that_left_too_few_pairs_is_named():
    """Each cause occurs alone; the other counts in the message are those of the maps."""
    a, b = unlike_maps(np.random.default_rng(7))
    label = np.arange(40, dtype=np.int32)
    assert match(a, b).shortage == ""
    lifted = replace(b, position_m=b.position_m + np.array([0, 0, 1.0]))
    said = told_apart(a, lifted, one_floor=True)
    assert "40 mutually nearest descriptors, 0 within 0.23 m of height" in said
    assert "median difference 1.00 m" in said
    assert "times" not in said
    said = told_apart(a, replace(b, position_m=1000 * b.position_m, name="north"))
    assert "distances between landmarks of map north are 1000 times those of map" in said
    assert "millimetres" in said
    said = told_apart(a, replace(b, descriptor=None, label=label, name="north"))
    assert "has descriptors, map north only labels" in said
    # 0.01 of unit vectors of 64 numbers: 8 times that apart, more than the 0.05 allowed
    off = b.descriptor + np.random.default_rng(1).normal(0, 0.01, (40, 64))
    said = told_apart(a, replace(b, descriptor=off), max_descriptor_distance=0.05)
    assert "40 mutually nearest descriptors, 0 at most 0.05 apart (median 0.08" in said
    assert "different kinds" in said
    named = [replace(m, descriptor=None) for m in (a, b)]
    said = told_apart(replace(named[0], label=label), replace(named[1], label=label + 100))
    assert "none are labels of both maps" in said
    assert "40 from 0 to 39" in said
    assert "40 from 100 to 139" in said
    said = told_apart(a, replace(named[1], label=label))
    assert f"{a.called} has descriptors, {b.called} only labels" in said
    few = b.descriptor.copy()
    few[1:] = np.nan
    assert "1 mutually nearest descriptors" in told_apart(a, replace(b, descriptor=few))
    assert "is empty" in told_apart(a, b[np.zeros(0, np.int64)])


@pytest.mark.parametrize(
    ("factor", "unit"), [(1000, "millimetres"), (1 / 3.281, "feet"), (100, "centimetres"), (7, "")]
)
def test_a_scale_is_seen_among_false_pairs_and_none_without_one(factor, unit):
    rng = np.random.default_rng(2)
    for trial in range(20):
        a, b = unlike_maps(rng, 60)
        index = np.arange(60)
        shuffled = index.copy()
        shuffled[:25] = rng.permutation(25)  # two fifths of the pairs are false
        larger = replace(b, position_m=factor * b.position_m, name="north")
        said = scale_note(a, larger, index, shuffled)
        assert f" {max(factor, 1 / factor):.2g}" in said or f" {factor}" in said, (trial, said)
        assert (unit in said) if unit else ("are both in metres?" in said)
        larger_one = "north" if factor > 1 else a.name
        assert f"landmarks of {replace(a, name=larger_one).called} are" in said
        assert scale_note(a, b, index, shuffled) == ""
        assert scale_note(a, b, index, rng.permutation(60)) == ""
    far = replace(b, position_m=1000 * b.position_m, name="north")
    assert "spans" in scale_note(a, far, index, rng.permutation(60))


@pytest.mark.parametrize("n", [0, 1])
def test_labelled_maps_without_landmarks_give_no_pairs_and_say_so(n):
    none = replace(landmarks(np.zeros((0, 3))), label=np.zeros(0, np.int32))
    other = replace(landmarks(np.zeros((n, 3))), label=np.zeros(n, np.int32))
    assert "is empty" in match(none, other).shortage
    assert "is empty" in match(other, none).shortage
    nameless = replace(other, label=np.full(n, NO_LABEL, np.int32))
    assert len(match(nameless, nameless)) == 0
