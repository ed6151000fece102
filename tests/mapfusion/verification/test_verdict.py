"""Tests of `mapfusion.verification.verdict`."""

import itertools
import math
import re
from dataclasses import asdict, replace

import numpy as np
import pytest

from mapfusion.align.alignment import Alignment, Pairs, Status
from mapfusion.align.clique import Clique
from mapfusion.align.correspondences import match
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification import verdict as verdict_module
from mapfusion.verification.false_alarms import Acceptance, Verdict
from mapfusion.verification.likelihood import TwinShares
from mapfusion.verification.regions import EvidenceParameters, ViewedMap
from mapfusion.verification.registration import Registration
from mapfusion.verification.rivals import BETWEEN, RepeatedLandmarks, self_motions
from mapfusion.verification.verdict import RivalMotion, Verifier, landmark_sigma_m
from tests.mapfusion.verification.two_rooms import Wall, between, mapped

JUDGE = Verifier()


def verdict(a: LandmarkMap, b: LandmarkMap, judge: Verifier = JUDGE) -> tuple[Verdict, Alignment]:
    registration = Registration(Clique(), verifier=judge)
    done = registration.register(a, b, match(a, b), np.random.default_rng(0))
    return done.verdict, done.refined


COMMON = Wall(20, seed=1)
NICHES = Wall(20, seed=1, niches=True)
A, B = mapped(COMMON, 1, 11, seed=2, name="A"), mapped(COMMON, 4, 16, seed=3, name="B")


def test_common_ground_is_accepted_with_evidence() -> None:
    said, refined = verdict(A, B)
    assert said.status is Status.ACCEPTED
    assert said.reason == ""
    np.testing.assert_allclose(refined.T_a_b, between(1, 4), atol=0.03)
    assert said.n_confirmed >= 2
    assert said.log10_evidence > 1.5


@pytest.mark.parametrize(("log10_by_chance", "status"), [(4.0, "accepted"), (-0.5, "ambiguous")])
def test_a_rival_is_more_than_chance_by_pairs_and_regions_together(
    log10_by_chance: float, status: str
) -> None:
    """Another motion with as many confirmed regions is a rival only beyond chance."""
    pairs = match(A, B)
    sought = Registration(Clique()).on(A, B, pairs)
    assert sought.verifier is not None
    evidence, (said, refined) = sought.verifier.evidence, verdict(A, B)
    assert evidence is not None
    elsewhere = refined.T_a_b + np.array([0.0, 30.0, 0.0])
    none = RepeatedLandmarks.none(len(A), len(B))
    told = log10_by_chance, 9, 2, 0, 2, said.log10_evidence
    rival = RivalMotion(BETWEEN, elsewhere, *told, none)
    assert said.log10_evidence > 2.5
    known = replace(evidence, motions=(*evidence.motions, rival))
    registration = Registration(Clique()).on(A, B, pairs, known)
    answer = registration.register(np.random.default_rng(0)).verdict
    assert str(answer.status) == status


@pytest.mark.parametrize(("n_others", "status"), [(2, "accepted"), (4, "ambiguous")])
def test_the_best_of_more_motions_needs_more_evidence(n_others: int, status: str) -> None:
    """Other motions are beyond chance by their pairs and have no confirmed region."""
    pairs, (said, refined) = match(A, B), verdict(A, B)
    sought = Registration(Clique()).on(A, B, pairs)
    assert sought.verifier is not None
    evidence = sought.verifier.evidence
    assert evidence is not None
    none = RepeatedLandmarks.none(len(A), len(B))
    others = [
        RivalMotion(
            BETWEEN, refined.T_a_b + np.array([0.0, 30.0 * k, 0.0]), -5.0, 9, 0, 3, 3, -4.0, none
        )
        for k in range(1, n_others + 1)
    ]
    known = replace(evidence, motions=(*evidence.motions, *others))
    enough = EvidenceParameters(least_ratio=10**said.log10_evidence / 4)
    registration = Registration(Clique(), verifier=Verifier(evidence=enough)).on(A, B, pairs, known)
    answer = registration.register(np.random.default_rng(0)).verdict
    assert str(answer.status) == status
    assert ("too few beside" in answer.reason) == (status == "ambiguous")


@pytest.mark.parametrize("rivalled", [False, True])
def test_the_ratio_passed_is_the_largest_that_accepts(rivalled: bool) -> None:
    """Without repetition and rivals any ratio is passed; with another motion, half the evidence."""
    a, b = mapped(NICHES, 1, 11, seed=2, name="A"), mapped(NICHES, 4, 16, seed=3, name="B")
    pairs, (said, refined) = match(a, b), verdict(a, b)
    sought = Registration(Clique()).on(a, b, pairs)
    assert sought.verifier is not None
    known = sought.verifier.evidence
    assert known is not None
    assert said.log10_ratio_passed == math.inf
    if rivalled:
        none = RepeatedLandmarks.none(len(a), len(b))
        away = refined.T_a_b + np.array([0.0, 30.0, 0.0])
        rival = RivalMotion(BETWEEN, away, -5.0, 9, 0, 3, 3, -4.0, none)
        known = replace(known, motions=(*known.motions, rival))

    def judged(log10_ratio: float) -> Verdict:
        asked = Verifier(evidence=EvidenceParameters(least_ratio=10**log10_ratio))
        registration = Registration(Clique(), verifier=asked).on(a, b, pairs, known)
        return registration.register(np.random.default_rng(0)).verdict

    if not rivalled:
        assert judged(12.0).accepted
        return
    passed = judged(0.0).log10_ratio_passed
    assert passed == pytest.approx(said.log10_evidence - np.log10(2))
    assert judged(passed - 1e-6).accepted
    assert not judged(passed + 1e-6).accepted


def walls_with_one_picture(first_x: float, last_x: float) -> tuple[Wall, Wall]:
    """Two walls share one texture only."""
    first, second = Wall(16, seed=1), Wall(16, seed=8)
    inside = (first.p[:, 0] >= first_x) & (first.p[:, 0] < last_x)
    hidden = (second.p[:, 0] >= first_x) & (second.p[:, 0] < last_x)
    second.p = np.concatenate([second.p[~hidden], first.p[inside]])
    second.look = np.concatenate([second.look[~hidden], first.look[inside]])
    return first, second


def test_what_is_missing_makes_doubt_though_nothing_repeats() -> None:
    """A texture covers several regions, one of which led to the motion; as many are missing."""
    first, second = walls_with_one_picture(4, 8)
    said, _ = verdict(mapped(first, 4, 12, seed=4), mapped(second, 4, 12, seed=5))
    assert said.status is Status.AMBIGUOUS
    assert (said.n_confirmed, said.n_contradicted) == (3, 2)
    assert "too few beside 2 that are missing from one" in said.reason


def test_a_picture_in_two_worlds_is_contradicted_by_all_around_it() -> None:
    first, second = walls_with_one_picture(6, 8)
    said, refined = verdict(mapped(first, 2, 12, seed=4), mapped(second, 2, 12, seed=5))
    assert refined.ok
    assert said.status is Status.REFUSED
    assert said.log10_false_alarms < -3
    assert "contradicted" in said.reason


def test_a_picture_that_hangs_twice_leaves_two_places() -> None:
    """Map a contains both copies and nothing else of b's area; map b contains one copy."""
    wall = Wall(30, seed=6, copies=[(4, 2.0, 12.0)])
    other = Wall(30, seed=7)
    picture = (wall.p[:, 0] >= 4) & (wall.p[:, 0] < 6)
    other.p, other.look = wall.p[picture], wall.look[picture]  # on a wall that is bare
    small = Verifier(evidence=EvidenceParameters(place_m=1.0))  # b is one place
    said, _ = verdict(mapped(wall, 1, 15, seed=8), mapped(other, 3, 7, seed=9), small)
    assert said.status is Status.AMBIGUOUS
    assert "T_a_b" in said.reason or "hold things twice" in said.reason


def test_a_room_that_is_all_there_is_may_be_another_s_like() -> None:
    """Both robots see 4 m of one wall only; with surroundings the alignment is accepted."""
    room = Wall(4, seed=11)
    said, refined = verdict(mapped(room, 0, 4, seed=12), mapped(room, 0.5, 4, seed=13))
    assert refined.ok
    assert said.status is Status.AMBIGUOUS
    assert "little else than this place" in said.reason
    small = Verifier(evidence=EvidenceParameters(place_m=1.0, region_m=1.0))
    trusted, _ = verdict(mapped(room, 0, 4, seed=12), mapped(room, 0.5, 4, seed=13), small)
    assert trusted.status is Status.ACCEPTED


@pytest.mark.parametrize(("start_b", "passed"), [(10.0, 0.0), (7.0, math.inf)])
def test_what_agrees_within_two_regions_may_be_one_copy(start_b: float, passed: float) -> None:
    """Two robots share the end of a wall, and nothing around it."""
    small = Verifier(evidence=EvidenceParameters(place_m=1.0))
    a, b = mapped(NICHES, 1, 11, seed=2), mapped(NICHES, start_b, 19, seed=3)
    said, refined = verdict(a, b, small)
    np.testing.assert_allclose(refined.T_a_b, between(1, start_b), atol=0.05)
    assert said.log10_evidence > 1
    assert said.log10_ratio_passed == passed
    assert said.accepted == (passed > 0)


def test_a_few_supporters_elsewhere_do_not_make_a_copy_large() -> None:
    """All but two of the common landmarks lie within 2.5 m, the others 8 m away."""
    wall = Wall(20, seed=1, niches=True)
    x = wall.p[:, 0]
    kept = ((x >= 10) & (x < 12.5)) | ((x >= 2) & (x < 2.2))
    wall.p, wall.look = wall.p[kept], wall.look[kept]
    small = Verifier(evidence=EvidenceParameters(place_m=1.0))
    said, refined = verdict(mapped(wall, 1, 14, seed=2), mapped(wall, 1, 14, seed=3), small)
    assert refined.inlier.sum() > 20
    assert said.log10_ratio_passed < 2
    assert "nearly all that agrees lies within 4 m and could be a copy" in said.reason


def test_regions_beside_the_one_that_led_to_it_must_confirm_it() -> None:
    """If nearly all regions are copies under a wrong motion, regions that agree tell little."""
    a, b = mapped(NICHES, 1, 11, seed=2, name="A"), mapped(NICHES, 9, 19, seed=3, name="B")
    pairs = match(a, b)
    sought = Registration(Clique()).on(a, b, pairs)
    assert sought.verifier is not None
    known = sought.verifier.evidence
    assert known is not None
    for share, accepted in ((0.05, True), (0.95, False)):
        shared = replace(known, shares=TwinShares(share, share))
        registration = Registration(Clique()).on(a, b, pairs, shared)
        said = registration.register(np.random.default_rng(0)).verdict
        assert said.accepted == accepted
    assert said.log10_evidence < 1
    assert "too few to confirm it" in said.reason


@pytest.mark.parametrize("bend_m", [0.0, 0.15])
def test_what_agrees_on_one_wall_may_be_a_picture(bend_m: float) -> None:
    """Seven metres of a flat wall, bent by the drift of one map, need the regions' evidence."""
    small = Verifier(evidence=EvidenceParameters(place_m=1.0))
    bent = mapped(COMMON, 7, 19, seed=3, name="B")
    along_m = bent.position_m[:, 1]
    position_m = bent.position_m.copy()
    position_m[:, 0] += bend_m * np.cos(2 * np.pi * along_m / 7)
    said, refined = verdict(A, replace(bent, position_m=position_m), small)
    assert refined.ok
    assert said.log10_ratio_passed == pytest.approx(said.log10_evidence)
    assert 1 < said.log10_evidence < 3
    assert said.status is Status.AMBIGUOUS
    assert "lies on one wall and could be a picture" in said.reason


def test_without_viewing_evidence_it_is_said_that_none_was_sought() -> None:
    said, _ = verdict(replace(A, viewing=None), B)
    assert said.status is Status.ACCEPTED
    expected = (
        "another place that looks alike could not be ruled out: map A has no viewing evidence"
    )
    assert said.reason == f"{expected} (see `mapfusion docs refusal`)"
    assert math.isnan(said.log10_evidence)


def test_an_alignment_that_is_not_sure_enough_says_how_sure_it_is() -> None:
    strict = Verifier(evidence=EvidenceParameters(max_sigma_m=1e-3))
    said, _ = verdict(A, B, strict)
    assert said.status is Status.TOO_UNCERTAIN
    assert "0.001 m, 0.05 rad are allowed" in said.reason
    applied = said.applied_to(replace(verdict(A, B)[1]))
    assert applied.status is Status.TOO_UNCERTAIN
    assert not applied.ok


def test_what_was_found_before_gives_the_same_verdict() -> None:
    pairs = match(A, B)
    registration = Registration(Clique())
    sought = registration.on(A, B, pairs)
    assert sought.verifier is not None
    known = registration.on(A, B, pairs, sought.verifier.evidence)
    both = [each.register(np.random.default_rng(0)).verdict for each in (sought, known)]
    assert both[0] == both[1]


def test_a_map_in_several_pairs_is_asked_once_and_says_the_same(monkeypatch) -> None:
    """Results of one map are kept for several pairs, with the map as `a` and as `b`."""
    wall = Wall(20, seed=1, copies=[(2, 2, 12), (5, 1.5, 16)])
    ends = (1, 11), (4, 16), (7, 19)
    maps = [mapped(wall, *each, seed=k, name=f"R{k}") for k, each in enumerate(ends)]
    ready, asked = [ViewedMap(each) for each in maps], []

    def counted(landmarks: LandmarkMap, *settings):
        asked.append(landmarks.name)
        return self_motions(landmarks, *settings)

    monkeypatch.setattr(verdict_module, "self_motions", counted)
    for _ in range(2):
        for a, b in itertools.permutations(range(3), 2):
            pairs = Pairs(maps[a], maps[b], match(maps[a], maps[b]))
            found = JUDGE.on(pairs, viewed_maps=(ready[a], ready[b])).evidence
            n, fresh = len(asked), JUDGE.on(pairs).evidence
            assert len(asked) == n + 2
            del asked[n:]
            assert found is not None
            assert fresh is not None
            assert (found.shares, found.region_m) == (fresh.shares, fresh.region_m)
            assert any(each.of != BETWEEN and each.n_regions for each in found.motions)
            for own, other in zip(found.motions, fresh.motions, strict=True):
                np.testing.assert_equal(asdict(own), asdict(other))
    assert sorted(asked) == ["R0", "R1", "R2"]
    other = replace(JUDGE, acceptance=Acceptance(patch_m=0.5))
    changed = other.on(pairs, viewed_maps=(ready[a], ready[b])).evidence
    assert changed is not None
    assert len(asked) == 5


def test_the_sigma_is_of_landmarks_wherever_the_origins_are() -> None:
    """Distant origins of both maps do not change the verdict."""
    far = np.array([1000.0, -500.0, 0.0])
    moved = [replace(m, position_m=m.position_m + far, viewing=None) for m in (A, B)]
    near, _ = verdict(replace(A, viewing=None), replace(B, viewing=None))
    assert verdict(moved[0], moved[1])[0].status == near.status == Status.ACCEPTED


@pytest.mark.parametrize("field", ["gate_m", "region_m", "least_ratio", "max_sigma_m"])
def test_settings_out_of_range_are_named(field: str) -> None:
    with pytest.raises(ValueError, match=field):
        EvidenceParameters(**{field: -1.0})


COVARIANCE = np.array([[4.0, 1.0, -0.6], [1.0, 3.0, 0.5], [-0.6, 0.5, 0.4]]) * 1e-4
P_B = np.random.default_rng(0).uniform([2, -9], [12, 3], (40, 2))


@pytest.mark.parametrize("T_a_b", [[0.0, 0.0, 0.0], [5.0, -3.0, 2.1]])
def test_it_is_the_rms_of_what_drawn_alignments_do(T_a_b: list[float]) -> None:
    T = np.array(T_a_b)
    drawn = np.random.default_rng(1).multivariate_normal(T, COVARIANCE, 4000)
    laid = np.stack([se2.transform_points(each, P_B) for each in drawn])
    off = laid - se2.transform_points(T, P_B)
    expected = np.sqrt(np.mean(np.sum(off**2, axis=2)))
    assert landmark_sigma_m(T, COVARIANCE, P_B) == pytest.approx(expected, rel=0.03)


def test_where_the_frames_have_their_origins_does_not_matter() -> None:
    """The value does not depend on the origin of map b."""
    T, shift = np.array([1.0, 2.0, 0.7]), np.array([300.0, -80.0])
    cos, sin = np.cos(T[2]), np.sin(T[2])
    moved = se2.rotation(T[2]) @ shift
    J = np.eye(3)
    J[:2, 2] = sin * shift[0] + cos * shift[1], -cos * shift[0] + sin * shift[1]
    there = landmark_sigma_m(T - [*moved, 0.0], J @ COVARIANCE @ J.T, P_B + shift)
    assert there == pytest.approx(landmark_sigma_m(T, COVARIANCE, P_B), rel=1e-9)


TRUE = np.array([2.0, -1.0, 0.4])


def symmetric_rooms(seed: int, n_twins: int, n_other: int, n_kept: int) -> Pairs:
    """Return two maps of a room with landmarks that have a twin after half a turn, and others.

    Each map holds `n_kept` of the landmarks. Twins have the same descriptor but for noise.
    """
    rng = np.random.default_rng(seed)
    n = 2 * n_twins + n_other
    points = np.column_stack([rng.uniform(-4, 4, (n, 2)), rng.uniform(0.2, 1.5, n)])
    points[n_twins : 2 * n_twins] = points[:n_twins] * [-1, -1, 1]
    looks = rng.normal(size=(n, 64))
    looks[n_twins : 2 * n_twins] = looks[:n_twins]
    maps = []
    for name, T_map_room in (("a", np.zeros(3)), ("b", se2.inverse(TRUE))):
        kept = np.sort(rng.permutation(n)[:n_kept])
        own = points[kept] + rng.normal(0, 0.01, (n_kept, 3))
        own[:, :2] = se2.transform_points(T_map_room, own[:, :2])
        seen = looks[kept] + rng.normal(0, 0.15, (n_kept, 64))
        seen = (seen / np.linalg.norm(seen, axis=1)[:, None]).astype(np.float32)
        about = np.tile(1e-4 * np.eye(3), (n_kept, 1, 1)), np.ones(n_kept, np.int32)
        maps.append(LandmarkMap(own, *about, np.arange(n_kept), descriptor=seen, name=name))
    return Pairs(*maps, match(*maps))


@pytest.mark.parametrize("n_kept", [60, 52, 40])
@pytest.mark.parametrize("seed", range(7))
def test_a_symmetric_room_is_ambiguous_without_viewing_evidence(seed: int, n_kept: int) -> None:
    pairs = symmetric_rooms(seed, 30, 0, n_kept)
    done = Registration(Clique()).register(pairs.map_a, pairs.map_b, pairs.correspondences, None)
    assert done.verdict.status is Status.AMBIGUOUS
    named = re.findall(r"T_a_b = \((.*?) m, (.*?) m, (.*?) rad\)", done.verdict.reason)
    motions = np.array(named, float)
    assert len(motions) == 2
    for expected in (TRUE, se2.compose(np.array([0.0, 0.0, np.pi]), TRUE)):
        off = motions - expected
        off[:, 2] = se2.wrap(off[:, 2])
        assert np.abs(off).max(axis=1).min() < 0.1


@pytest.mark.parametrize(("n_twins", "n_other"), [(10, 40), (30, 10)])
@pytest.mark.parametrize("seed", range(5))
def test_a_room_with_other_landmarks_is_accepted_without_viewing_evidence(
    seed: int, n_twins: int, n_other: int
) -> None:
    pairs = symmetric_rooms(seed, n_twins, n_other, 2 * n_twins + n_other)
    done = Registration(Clique()).register(pairs.map_a, pairs.map_b, pairs.correspondences, None)
    assert done.verdict.accepted
    assert np.abs(done.refined.T_a_b - TRUE).max() < 0.05
