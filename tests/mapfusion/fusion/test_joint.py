"""Joint fusion against a general solver, a known law of error, and what must make no difference."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from mapfusion.align.clique import Clique
from mapfusion.align.correspondences import match
from mapfusion.camera import CalibrationError
from mapfusion.fusion.fusers import AlignedPair, FusedMap, MergeParameters
from mapfusion.fusion.joint import JointFuser
from mapfusion.fusion.joint_estimate import JointMap, estimate_jointly
from mapfusion.fusion.kalman import KalmanDrift
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from mapfusion.smoother.robust_loss import information_share
from mapfusion.verification.registration import Registration
from tests.mapfusion.fusion.drawn_maps import BENT_M, DrawnTeam

OPPOSITE = [slice(0, 40), slice(25, 65), slice(50, 90)]  # the first and the last share nothing


def _fused(team: DrawnTeam, pairs=None, fuser=None) -> FusedMap:
    pairs = team.pairs if pairs is None else pairs
    return merge(team.maps, pairs, MergeParameters(), fuser or JointFuser()).fused[0]


def _errors(team: DrawnTeam, fused: FusedMap) -> np.ndarray:
    """(N, 3) in the frame of the first member; NaN where parents are not one."""
    first = int(fused.members[0])
    world = np.full((len(fused.landmarks), len(team.maps)), ABSENT)
    for k, part in enumerate(team.parts):
        has = fused.parents[:, k] != ABSENT
        world[has, k] = part.start + fused.parents[has, k]
    point = world.max(axis=1)
    truth = se2.transform_points(se2.inverse(team.T_world_map[first]), team.world_m[point])
    one = np.all((world == point[:, None]) | (world == ABSENT), axis=1, keepdims=True)
    return np.where(one, fused.landmarks.position_m - truth, np.nan)


@pytest.mark.parametrize("planar", [False, True])
def test_equals_a_general_solver_that_knows_the_weights(planar: bool) -> None:
    """Motions, shared variables and points as unknowns, derivatives by differences."""
    team, n_dimensions = (
        DrawnTeam([slice(0, 12), slice(4, 16), slice(8, 20)], 0, planar),
        2 + (not planar),
    )
    maps = [JointMap.of(own, 0.0, 0.0, n_dimensions) for own in team.maps]
    start = np.array([se2.between(team.T_world_map[0], T) for T in team.T_world_map])
    parents = np.full((20, 3), ABSENT)
    for k, part in enumerate(team.parts):
        parents[part, k] = np.arange(12)
    parents = parents[np.count_nonzero(parents != ABSENT, axis=1) > 1]
    found = estimate_jointly(maps, start, parents)
    n, ranks = len(parents), [own.joint.rank for own in maps]
    first = np.cumsum([0, 3, 3, *ranks])

    def residuals(u: np.ndarray, weight: np.ndarray) -> np.ndarray:
        T = [np.zeros(3), u[:3], u[3:6]]
        g = u[first[-1] :].reshape(n, n_dimensions)
        parts = [u[6 : first[-1]]]
        for k, own in enumerate(maps):
            z, rows = u[first[2 + k] : first[3 + k]], parents[:, k]
            for c in np.flatnonzero(rows != ABSENT):
                x = own.position_m[rows[c]] + own.joint.common_m[rows[c], :, :n_dimensions].T @ z
                R = se2.rotation_about_z(T[k][2])[:n_dimensions, :n_dimensions]
                S = R @ own.joint.own_m2[rows[c], :n_dimensions, :n_dimensions] @ R.T
                off = se2.transform_points(T[k], x[None])[0] - g[c]
                parts.append(weight[c, k] ** 0.5 * np.linalg.solve(np.linalg.cholesky(S), off))
        return np.concatenate(parts)

    guess = [start[1], start[2], np.zeros(sum(ranks)), np.zeros(n * n_dimensions)]
    weight = found.weight / information_share(found.dof, n_dimensions)
    solved = least_squares(
        residuals, np.concatenate(guess), args=(weight,), xtol=1e-14, ftol=1e-14, gtol=1e-12
    )
    stated = least_squares(residuals, solved.x, args=(found.weight,), max_nfev=1)
    covariance = np.linalg.inv(stated.jac.T @ stated.jac)[: first[-1], : first[-1]]
    sigma, n_unknowns = np.sqrt(np.diag(covariance)), len(covariance)
    off = (found.covariance - covariance) / np.outer(sigma, sigma)
    assert np.abs(off).max() < 5e-3  # either is linearised where it ended
    ours = np.concatenate([found.T_first_map[1:].ravel(), *found.shared])
    assert np.abs((ours - solved.x[:n_unknowns]) / sigma).max() < 0.05


def test_errors_obey_the_joint_covariance() -> None:
    """Errors of motions and landmarks obey it, in the frame of the first map."""
    seeds, squares, motions, inside = range(30), [], [], []
    for seed in seeds:
        team = DrawnTeam(OPPOSITE, seed)
        fused = _fused(team)
        e = _errors(team, fused)
        known = np.isfinite(e).all(axis=1)
        assert known.mean() > 0.97
        joint = fused.landmarks[known].joint
        assert joint is not None
        squares.append(
            e[known].ravel() @ np.linalg.solve(joint.dense_m2(), e[known].ravel()) / known.sum() / 3
        )
        S, off = fused.landmarks.covariance_m2[known], e[known]
        nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(S), off)
        inside.append(np.mean(nees <= chi2.ppf(0.95, 3)))
        for k in (1, 2):
            T = se2.between(team.T_world_map[0], team.T_world_map[k])
            off = fused.T_first_map[k] - T
            off[2] = se2.wrap(off[2])
            motions.append(off @ np.linalg.solve(fused.motion_covariance[k], off))
    # 30 seeds of 270 coordinates: the mean of the first is known to 1.6 %; the gate of 99 % and the
    # Student-t, which has its weights from the same residuals, take some of the largest errors out
    assert 0.9 < np.mean(squares) < 1.1
    assert 0.93 < np.mean(inside) < 0.98
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 3 * len(motions)) / (3 * len(motions))
    assert low < np.mean(motions) / 3 < high


LEFT_OPEN = CalibrationError(0.002, 0.005)


def _through_cameras(team: DrawnTeam, seed: int, camera: str) -> list[LandmarkMap]:
    """The maps, moved by drawn errors of cameras; with a name all have the same."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(len(team.maps), 2))
    z = z[[0] * len(z)] if camera else z
    moved = [
        own.position_m + np.einsum("r,nri->ni", its, LEFT_OPEN.moves_m(team.truth(k)))
        for k, (own, its) in enumerate(zip(team.maps, z, strict=True))
    ]
    known = replace(LEFT_OPEN, camera=camera)
    return [
        replace(own, position_m=p, calibration=known)
        for own, p in zip(team.maps, moved, strict=True)
    ]


@pytest.mark.parametrize("camera", ["", "one"])
def test_errors_obey_what_cameras_leave_open(camera: str) -> None:
    squares = []
    for seed in range(30):
        team = DrawnTeam(OPPOSITE, seed)
        maps = _through_cameras(team, seed, camera)
        fused = merge(maps, team.pairs, MergeParameters(), JointFuser()).fused[0]
        e = _errors(team, fused)
        known = np.isfinite(e).all(axis=1)
        joint = fused.landmarks[known].joint
        assert joint is not None
        off = e[known].ravel()
        squares.append(off @ np.linalg.solve(joint.dense_m2(), off) / known.sum() / 3)
    assert 0.9 < np.mean(squares) < 1.1


@pytest.mark.parametrize("camera", ["", "one"])
def test_noise_does_not_shrink_maps_whose_scale_is_open(camera: str) -> None:
    """Residuals of smaller maps are smaller: the mean of all scales, which nothing tells, stays."""
    team = DrawnTeam([slice(0, 300), slice(0, 300)], 0)
    known = CalibrationError(scale=0.01, camera=camera)
    maps = [JointMap.of(replace(own, calibration=known), 0.0, 0.0, 3) for own in team.maps]
    start = np.array([np.zeros(3), se2.between(*team.T_world_map)])
    found = estimate_jointly(maps, start, np.tile(np.arange(300)[:, None], 2))
    scales = np.array([z[-1] for z in found.shared])
    assert abs(scales.mean()) < 0.3  # sigmas; the noise of 600 points would have them at -8


def test_landmarks_that_one_robot_alone_has_seen_are_straightened_too() -> None:
    """By what the others say of its bends; landmark by landmark nobody can."""
    alone, carried = [], []
    for seed in range(10):
        team = DrawnTeam([slice(0, 60), slice(20, 80)], seed)
        for fuser, errors in ((JointFuser(), alone), (KalmanDrift(), carried)):
            fused = _fused(team, fuser=fuser)
            e = np.linalg.norm(_errors(team, fused)[:, :2], axis=1)
            errors.append(np.nanmean(e[np.count_nonzero(fused.parents != ABSENT, axis=1) == 1]))
    assert np.mean(alone) < 0.8 * np.mean(carried)


def test_false_pairs_do_not_move_the_map() -> None:
    right, misled = [], []
    for seed in range(5):
        team = DrawnTeam(OPPOSITE, seed)
        for pairs, errors in ((team.pairs, right), (team.with_false_pairs(0.15), misled)):
            fused = _fused(team, pairs)
            e = _errors(team, fused)
            assert np.isnan(e).any(axis=1).mean() < 0.02
            errors.append(np.sqrt(np.nanmean(e**2)))
    assert np.mean(misled) < 1.05 * np.mean(right)


def test_the_order_of_maps_changes_nothing_but_the_frame() -> None:
    team = DrawnTeam(OPPOSITE, 3)
    one = _fused(team)
    order = [2, 0, 1]
    place = {k: at for at, k in enumerate(order)}
    maps = [team.maps[k] for k in order]
    pairs = [replace(pair, a=place[pair.a], b=place[pair.b]) for pair in reversed(team.pairs)]
    other = merge(maps, pairs, MergeParameters(), JointFuser()).fused[0]
    row_of = {tuple(own): row for row, own in enumerate(other.parents[:, np.argsort(order)])}
    rows = np.array([row_of[tuple(own)] for own in one.parents])
    T_first_third = one.T_first_map[2]
    moved = se2.transform_points(T_first_third, other.landmarks.position_m[rows])
    # both stop within a thousandth of a squared sigma of the same place
    np.testing.assert_allclose(moved, one.landmarks.position_m, atol=2e-4)


def test_maps_without_a_joint_covariance_are_fused_by_what_they_have() -> None:
    team = DrawnTeam(OPPOSITE, 4)
    team.maps = [replace(own, joint=None) for own in team.maps]
    fused = _fused(team)
    assert np.nanmax(np.abs(_errors(team, fused))) < 10 * BENT_M
    assert np.count_nonzero(fused.parents != ABSENT, axis=1).max() == 2


def test_a_map_that_nothing_connects_stays_as_it_is() -> None:
    team = DrawnTeam(OPPOSITE, 5)
    fused = _fused(team, [])
    np.testing.assert_array_equal(fused.members, [0])
    order = fused.parents[:, 0]
    np.testing.assert_allclose(fused.landmarks.position_m, team.maps[0].position_m[order])
    np.testing.assert_allclose(fused.landmarks.covariance_m2, team.maps[0].covariance_m2[order])


def test_a_known_identity_needs_no_gate() -> None:
    team = DrawnTeam(OPPOSITE, 6)
    for k, own in enumerate(team.maps):
        label = np.arange(team.parts[k].start, team.parts[k].stop).astype(np.int32)
        moved = own.position_m + (np.arange(len(own)) == len(own) - 1)[:, None] * [1.0, 0, 0]
        team.maps[k] = replace(own, label=label, descriptor=None, position_m=moved)
    fused = _fused(team)
    assert len(fused.landmarks) == 90


def test_the_gate_keeps_the_share_of_true_pairs_that_it_promises() -> None:
    """Errors that two maps share cancel; otherwise the gate would keep nearly all pairs."""
    kept = []
    for seed in range(8):
        team = DrawnTeam([slice(0, 300), slice(0, 300)], seed)
        kept.append(np.sum(np.all(_fused(team).parents != ABSENT, axis=1)) / 300)
    missed = 1 - np.mean(kept)
    # 2400 pairs: 0.01 is known to 0.002, and fits are nearer to their own pairs than to others
    assert 0.004 < missed < 0.014


def test_neighbours_that_look_alike_are_no_duplicates() -> None:
    """They are further apart than their own errors allow, though not than their map is bent."""
    team = DrawnTeam(OPPOSITE, 7)
    own = team.maps[0]
    twins = np.repeat(np.arange(len(own)), 2)
    apart = np.where(np.arange(len(twins)) % 2, 0.15, 0.0)[:, None] * [1.0, 0, 0]
    twice = own[twins]
    team.maps[0] = replace(
        twice, position_m=twice.position_m + apart, source_observation=np.arange(len(twins))
    )
    fused = _fused(team, [])
    assert fused.duplicate_share < 0.1


def test_landmarks_that_nothing_describes_are_joined_by_what_alignments_say() -> None:
    """Neither descriptors nor labels: nothing else tells which are one."""
    team = DrawnTeam(OPPOSITE, 3)
    named = _fused(team)
    team.maps = [replace(own, descriptor=None) for own in team.maps]
    found = _fused(team)
    several = np.count_nonzero(found.parents != ABSENT, axis=1) > 1
    assert np.count_nonzero(several) >= 0.95 * sum(len(pair.inliers) for pair in team.pairs)
    assert np.nanmax(np.abs(_errors(team, found))) < 1.5 * np.nanmax(np.abs(_errors(team, named)))
    assert found.fallback == ""


@pytest.mark.parametrize("n_left", [0, 2])
def test_maps_that_no_landmarks_tie_are_fused_by_what_stands_in(n_left: int) -> None:
    """As after smoothing, which may leave none of an alignment's landmarks in a map."""
    team = DrawnTeam([slice(0, 40), slice(20, 60)], 4)
    pair = team.pairs[0]
    few = replace(pair.alignment, inlier=np.arange(len(pair.inliers)) < n_left)
    pairs = [replace(pair, alignment=few)]
    found, instead = _fused(team, pairs), _fused(team, pairs, KalmanDrift())
    np.testing.assert_array_equal(found.landmarks.position_m, instead.landmarks.position_m)
    assert "landmarks in common with the others" in found.fallback


def test_covariances_that_cannot_be_computed_with_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr("mapfusion.fusion.joint.estimate_jointly", fails)
    team = DrawnTeam([slice(0, 40), slice(20, 60)], 4)
    found, instead = _fused(team), _fused(team, team.pairs, KalmanDrift())
    np.testing.assert_array_equal(found.landmarks.position_m, instead.landmarks.position_m)
    assert "differ too much in size" in found.fallback


def test_a_wrong_alignment_whose_pairs_pass_no_gate_breaks_nothing() -> None:
    """A motion metres off, of landmarks that do not look alike: the gate refuses them all."""
    team = DrawnTeam([slice(0, 40), slice(20, 60)], 5)
    rng = np.random.default_rng(0)
    pair = team.pairs[0]
    wrong = replace(pair.correspondences, index_b=rng.permutation(pair.inliers.index_b))
    team.maps[1] = replace(team.maps[1], descriptor=-team.maps[1].descriptor)
    found = _fused(team, [replace(pair, correspondences=wrong)])
    assert np.isfinite(found.landmarks.position_m).all()
    assert np.isfinite(found.T_first_map).all()


@pytest.mark.parametrize(("dof", "least", "most"), [(2.5, 1.5, 6.0), (None, 20.0, np.inf)])
def test_tails_are_found_and_no_tail_is_cut_off(
    dof: float | None, least: float, most: float
) -> None:
    """Landmarks as far off as a Student-t has them: a Gaussian's gate would leave many apart."""
    parts, rng = [slice(0, 300), slice(0, 300)], np.random.default_rng(6)
    team = DrawnTeam(parts, 6)
    if dof is not None:
        for k, own in enumerate(team.maps):
            assert own.joint is not None
            scale = np.sqrt(dof / rng.chisquare(dof, (300, 1))) - 1  # beyond what is drawn already
            root = np.linalg.cholesky(own.joint.own_m2)
            more = np.einsum("nij,nj->ni", root, rng.normal(size=(300, 3))) * np.maximum(scale, 0)
            team.maps[k] = replace(own, position_m=own.position_m + 1.5 * more)
    start = np.array([np.zeros(3), team.pairs[0].alignment.T_a_b])
    maps = [JointMap.of(own, 0.0, 0.0, 3) for own in team.maps]
    rows = np.arange(300)
    found = estimate_jointly(maps, start, np.column_stack([rows, rows]))
    assert least < found.dof < most
    several = np.count_nonzero(_fused(team).parents != ABSENT, axis=1) > 1
    assert np.count_nonzero(several) >= 0.98 * 300


def test_a_fused_landmark_looks_as_the_parent_that_was_seen_most() -> None:
    team, rng = DrawnTeam([slice(0, 40), slice(10, 50), slice(20, 60)], 4), np.random.default_rng(4)
    counts = np.split(rng.permutation(120).astype(np.int32) + 3, 3)
    team.maps = [replace(own, count=n) for own, n in zip(team.maps, counts, strict=True)]
    fused = _fused(team)
    assert fused.landmarks.descriptor is not None
    for row, parents in enumerate(fused.parents):
        own = [(counts[k][i], team.maps[k].descriptor[i]) for k, i in enumerate(parents) if i >= 0]
        most = max(own, key=lambda each: each[0])
        np.testing.assert_array_equal(fused.landmarks.descriptor[row], most[1])
        assert fused.landmarks.count[row] == sum(n for n, _ in own)


def test_weights_of_a_student_t_are_1_in_the_mean() -> None:
    """The E step of Lange et al. (1989) expects this of errors about the true points."""
    dof, means, rows = 2.5, [], np.arange(300)
    for seed in range(2):
        rng, team = np.random.default_rng(seed), DrawnTeam([slice(0, 300)] * 3, seed)
        for k, own in enumerate(team.maps):
            assert own.joint is not None
            root = np.linalg.cholesky(own.joint.own_m2)
            scale = np.sqrt(dof / rng.chisquare(dof, (300, 1)))
            off = scale * np.einsum("nij,nj->ni", root, rng.normal(size=(300, 3)))
            off += np.einsum("nri,r->ni", own.joint.common_m, rng.normal(size=own.joint.rank))
            team.maps[k] = replace(own, position_m=team.truth(k) + off)
        maps = [JointMap.of(own, 0.0, 0.0, 3) for own in team.maps]
        start = np.array([np.zeros(3), *(pair.alignment.T_a_b for pair in team.pairs[:2])])
        found = estimate_jointly(maps, start, np.column_stack([rows] * 3))
        means.append(found.weight.mean() / information_share(found.dof, 3))
    assert np.mean(means) == pytest.approx(1.0, abs=0.06)


def test_drift_counts_as_a_landmark_s_own_where_nothing_is_shared() -> None:
    (own,) = DrawnTeam([slice(0, 10)], 0).maps
    made = JointMap.of(replace(own, joint=None), 0.3, 0.2, 3)
    assert made.n_shared == 0
    np.testing.assert_allclose(made.joint.own_m2, own.covariance_m2 + np.diag([0.09, 0.09, 0.04]))
    assert JointMap.of(own, 0.3, 0.2, 3).joint is own.joint  # which has it all


@pytest.mark.parametrize("seed", range(4))
def test_covariances_that_are_too_small_leave_no_duplicates(seed: int) -> None:
    """Errors of 20 mm in all directions, of which the maps state a twentieth."""
    rng, n, T_a_b = np.random.default_rng(seed), 60, np.array([2.0, -1.0, 0.4])
    point = rng.uniform([-4, -4, 0.2], [4, 4, 1.5], (n, 3))
    looks = rng.normal(size=(n, 64))
    looks = (looks / np.linalg.norm(looks, axis=1)[:, None]).astype(np.float32)
    about = np.tile(1e-6 * np.eye(3), (n, 1, 1)), np.ones(n, np.int32), np.arange(n), looks
    in_b = point.copy()
    in_b[:, :2] = se2.transform_points(se2.inverse(T_a_b), point[:, :2])
    maps = [
        LandmarkMap(own + rng.normal(0, 0.02, (n, 3)), *about, name=name)
        for name, own in (("a", point), ("b", in_b))
    ]
    done = Registration(Clique()).register(*maps, match(*maps), rng)
    assert "times as large as the maps' covariances state" in done.verdict.reason
    pair = AlignedPair(0, 1, done.applied, match(*maps))
    fused = merge(maps, [pair]).fused[0]
    assert len(fused.landmarks) <= n + 2
    assert np.hypot(*(fused.T_first_map[1] - T_a_b)[:2]) < 0.012
    assert abs(fused.T_first_map[1, 2] - T_a_b[2]) < 0.004


def test_inliers_of_alignments_need_no_alike_descriptors() -> None:
    """Landmarks look different from the other side, except for five of them."""
    team = DrawnTeam([slice(0, 40), slice(20, 60)], 5)
    other = np.random.default_rng(1).normal(size=team.maps[1].descriptor.shape).astype(np.float32)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    other[:5] = team.maps[1].descriptor[:5]
    team.maps[1] = replace(team.maps[1], descriptor=other)
    n_inliers = len(team.pairs[0].inliers)
    assert n_inliers == 20
    fused = _fused(team)
    assert not fused.fallback
    both = np.all(fused.parents != ABSENT, axis=1)
    assert np.count_nonzero(both) >= 0.9 * n_inliers
    np.testing.assert_array_equal(fused.parents[both, 0], fused.parents[both, 1] + 20)
