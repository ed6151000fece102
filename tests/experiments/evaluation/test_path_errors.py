"""Tests of `experiments.evaluation.path_errors`."""

import itertools
import math

import numpy as np
import pandas as pd
import pytest
from evo.core import metrics
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from scipy.optimize import least_squares

from experiments.evaluation.alignment_criteria import edge_precision, edge_recall, path_rms
from experiments.evaluation.fused_landmarks import FusedTeam
from experiments.evaluation.path_errors import (
    SOURCES,
    STATISTICS,
    ate_m,
    pairs_by_frames,
    pairs_by_length,
    path_statistics_rows,
    rpe,
    seven_statistics,
    team_pair_rows,
    team_rows,
)
from experiments.evaluation.truth import EvaluatedRobot, MapPair, PathTruth
from mapfusion.align.correspondences import Correspondences
from mapfusion.fusion.fusers import FusedMap, Fusion
from mapfusion.fusion.team_graph import EdgeStatus
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from tests.helpers.made_up_maps import ITERATION, NO_RIVALS, landmark_map


def wander(rng: np.random.Generator, n: int) -> tuple[Float, Float]:
    """A true path (n, 3) and an estimate of it in another frame, with drift and noise."""
    steps = np.column_stack(
        [rng.uniform(0, 0.2, n), rng.normal(0, 0.02, n), rng.normal(0, 0.15, n)]
    )
    truth, path = np.zeros((n, 3)), np.zeros((n, 3))
    for i in range(1, n):
        truth[i] = se2.compose(truth[i - 1], steps[i])
        path[i] = se2.compose(path[i - 1], steps[i] + rng.normal(0, [0.02, 0.02, 0.01]))
    return truth, se2.compose(rng.normal(0, 3, 3), path)


def evo_path(poses: Float) -> PosePath3D:
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    for matrix, pose in zip(matrices, poses, strict=True):
        matrix[:2, :2], matrix[:2, 3] = se2.rotation(pose[2]), pose[:2]
    return PosePath3D(poses_se3=list(matrices))


def evo_rpe(path: Float, truth: Float, relation: metrics.PoseRelation, delta, unit) -> dict:
    measured = metrics.RPE(relation, delta, unit, pairs_from_reference=True)
    measured.process_data((evo_path(truth), evo_path(path)))
    return measured.get_all_statistics()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("fit", [False, True])
def test_ate_equals_evos(fit: bool, seed: int) -> None:
    truth, path = wander(np.random.default_rng(seed), 180)
    reference, estimate = evo_path(truth), evo_path(path)
    if fit:
        estimate.align(reference, correct_scale=False)
    measured = metrics.APE(metrics.PoseRelation.translation_part)
    measured.process_data((reference, estimate))
    ours = seven_statistics(ate_m(path, truth, fit))
    assert set(ours) == set(STATISTICS)
    assert ours == pytest.approx(measured.get_all_statistics(), rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("delta", "unit"), [(1, "frames"), (7, "frames"), (1.0, "m"), (2.5, "m")])
def test_rpe_equals_evos(delta: float, unit: str, seed: int) -> None:
    truth, path = wander(np.random.default_rng(10 + seed), 180)
    if unit == "frames":
        pairs, evo_unit = pairs_by_frames(np.ones(180, bool), int(delta)), metrics.Unit.frames
    else:
        pairs, evo_unit = pairs_by_length(truth[:, :2], delta), metrics.Unit.meters
    length_m, angle_rad = rpe(path, truth, pairs)
    for errors, relation in (
        (length_m, metrics.PoseRelation.translation_part),
        (angle_rad, metrics.PoseRelation.rotation_angle_rad),
    ):
        expected = evo_rpe(path, truth, relation, delta, evo_unit)
        assert seven_statistics(errors) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_a_path_moved_as_a_whole_has_no_error_but_from_its_start() -> None:
    truth, _ = wander(np.random.default_rng(1), 50)
    moved = se2.compose(np.array([3.0, 4.0, 0.0]), truth)
    np.testing.assert_allclose(ate_m(moved, truth), 0, atol=1e-9)
    np.testing.assert_allclose(ate_m(moved, truth, fit=False), 5, atol=1e-9)


def test_frames_without_truth_are_left_out() -> None:
    known = np.array([1, 1, 0, 1, 1, 1, 1], bool)
    assert pairs_by_frames(known, 1).tolist() == [[0, 1], [2, 3], [3, 4], [4, 5]]
    assert pairs_by_frames(known, 2).tolist() == [[3, 5]]  # frames 4 and 6
    assert pairs_by_frames(known, 9).tolist() == []


def paths_table(truth: Float, path: Float) -> pd.DataFrame:
    columns = {"robot": "R1", "iteration": np.arange(len(path))}
    for source, poses in (("final", path), ("online", path), ("odometry", path), ("truth", truth)):
        columns |= {f"{source}_{n}": poses[:, i] for i, n in enumerate(("x_m", "y_m", "theta_rad"))}
    return pd.DataFrame(columns)


def test_table_has_each_source_and_quantity_and_lives_with_gaps() -> None:
    truth, path = wander(np.random.default_rng(2), 120)
    truth[40:55] = np.nan
    rows = pd.DataFrame(path_statistics_rows(paths_table(truth, path)))
    assert len(rows) == 3 * 6
    ate = rows[(rows["source"] == "final") & (rows["quantity"] == "ate_m")].iloc[0]
    known = np.isfinite(truth[:, 0])
    assert ate["n"] == 105
    assert ate["rmse"] == np.sqrt(np.mean(ate_m(path[known], truth[known]) ** 2))
    frames = rows[(rows["quantity"] == "rpe_m") & (rows["delta_unit"] == "frames")]
    assert (frames["n"] == 40 - 1 + 65 - 1).all()


@pytest.mark.parametrize("known", [0, 1, 2])
def test_hardly_any_truth(known: int) -> None:
    truth, path = wander(np.random.default_rng(3), 5)
    truth[known:] = np.nan
    rows = pd.DataFrame(path_statistics_rows(paths_table(truth, path)))
    assert (rows[rows["quantity"] == "ate_m"]["n"] == known).all()
    assert rows[rows["delta_unit"] == "m"]["rmse"].isna().all()


def test_rms_over_a_run_is_of_what_is_known() -> None:
    rows = [("A", 3.0, 6.0), ("A", 4.0, 8.0), ("B", 2.0, 0.0), ("B", np.nan, 0.0)]
    robots = pd.DataFrame(rows, columns=["robot", "path_error_m", "odometry_error_m"])
    found = path_rms(robots.assign(n_landmarks=[1, 5, 2, 7])).set_index("robot")
    assert found["path_m"].tolist() == [np.sqrt(12.5), 2.0]
    assert found["odometry_m"].tolist() == [np.sqrt(50), 0.0]
    assert found.loc["A", "over_odometry"] == pytest.approx(0.5)
    assert np.isnan(found.loc["B", "over_odometry"])
    assert found[["n_landmarks", "n_frames"]].to_numpy().tolist() == [[5, 2], [7, 2]]


def test_a_smoothed_path_is_a_source_where_there_is_one() -> None:
    truth, path = wander(np.random.default_rng(4), 40)
    with_one = paths_table(truth, path)
    for name in ("x_m", "y_m", "theta_rad"):
        with_one[f"smoothed_{name}"] = with_one[f"truth_{name}"]
    rows = pd.DataFrame(path_statistics_rows(with_one))
    assert rows.loc[rows["source"] == "smoothed", "rmse"].to_numpy() == pytest.approx(0, abs=1e-9)
    without = with_one.assign(smoothed_x_m=np.nan, smoothed_y_m=np.nan, smoothed_theta_rad=np.nan)
    assert set(pd.DataFrame(path_statistics_rows(without))["source"]) == {*SOURCES} - {"smoothed"}


def test_a_way_of_just_the_length_is_long_enough() -> None:
    """Steps of a quarter of a metre add up exactly: four of them are one metre."""
    positions = np.column_stack([0.25 * np.arange(10), np.zeros(10)])
    assert pairs_by_length(positions, 1.0).tolist() == [[0, 4], [4, 8]]


NAMES = ("x_m", "y_m", "theta_rad")
STARTS = np.array([[1.0, 2.0, 0.3], [4.0, -1.0, 3.0], [-2.0, 0.5, -1.2]])


def team_of(
    T_first_map: Float, starts: Float = STARTS, places: tuple[EdgeStatus, ...] = ()
) -> FusedTeam:
    """Robots that start at these places, and the motions that put their maps into one frame.

    (G, M, 3) of several maps; NaN for a robot that has no part in one.
    """
    robots = []
    for k, start in enumerate(starts):
        landmarks, path = (
            landmark_map(np.zeros((1, 3)), f"R{k}"),
            PathTruth(np.zeros((1, 3)), start),
        )
        robots.append(
            EvaluatedRobot(f"R{k}", {ITERATION: landmarks}, {ITERATION: np.zeros((1, 3))}, path)
        )
    if len(robots) < 2:
        return FusedTeam(robots, [], ITERATION, None)
    none = Correspondences(np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    met = [
        MapPair(a, b, ITERATION, (a.at(0)[0], b.at(0)[0]), (), none, pd.DataFrame(), NO_RIVALS)  # type: ignore[arg-type]
        for a, b in itertools.combinations(robots, 2)
    ]
    none_m, none_m2 = np.zeros(len(robots)), np.zeros((len(robots), 3, 3))
    fused = tuple(
        FusedMap(robots[0].at(0)[0], np.zeros((0, len(robots))), T, none_m2, none_m, 0.0, ())
        for T in np.asarray(T_first_map).reshape(-1, len(robots), 3)
    )
    return FusedTeam(
        robots, met, ITERATION, Fusion(fused, places or (EdgeStatus.BRIDGE,) * len(met))
    )


def paths_of(each: list[tuple[Float, Float]]) -> pd.DataFrame:
    """Rows of `paths`: estimated and true poses (n, 3) of each robot in its own frame."""
    rows = []
    for k, (path, truth) in enumerate(each):
        columns = {"robot": f"R{k}", "iteration": np.arange(len(path))}
        for source in ("final", "online", "odometry", "truth"):
            poses = truth if source == "truth" else path
            columns |= {f"{source}_{name}": poses[:, i] for i, name in enumerate(NAMES)}
        rows.append(pd.DataFrame(columns))
    return pd.concat(rows, ignore_index=True)


def driven(rng: np.random.Generator, n: int) -> tuple[Float, Float]:
    """An estimated and a true path (n, 3) that both begin at the identity."""
    path, truth = np.zeros((n, 3)), np.zeros((n, 3))
    for i in range(1, n):
        step = np.array([0.1, 0.0, rng.normal(0, 0.2)])
        truth[i] = se2.compose(truth[i - 1], step)
        path[i] = se2.compose(path[i - 1], step + rng.normal(0, [0.02, 0.02, 0.02]))
    return path, truth


def final(rows: list[dict], component: int = 1) -> dict:
    (row,) = (r for r in rows if r["source"] == "final" and r["component"] == component)
    return row


def test_one_robot_is_its_own_ate() -> None:
    paths = paths_of([driven(np.random.default_rng(0), 120)])
    rows = team_rows(team_of(np.zeros((1, 3)), STARTS[:1]), paths)
    own = pd.DataFrame(path_statistics_rows(paths)).query("quantity == 'ate_m'")
    for row, single in zip(rows, own.to_dict("records"), strict=True):
        assert (row["source"], row["n"]) == (single["source"], single["n"])
        for name in STATISTICS:
            assert row[name] == pytest.approx(single[name], rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_team_is_evos_ape_of_all_poses_in_one_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    each = [driven(rng, n) for n in (80, 120, 60)]
    T_first_map = se2.between(STARTS[0], STARTS) + rng.normal(0, [0.1, 0.1, 0.02], (3, 3))
    T_first_map[0] = 0.0
    row = final(team_rows(team_of(T_first_map), paths_of(each)))
    estimated = evo_path(
        np.concatenate(
            [se2.compose(T, path) for T, (path, _) in zip(T_first_map, each, strict=True)]
        )
    )
    true = evo_path(
        np.concatenate([se2.compose(T, truth) for T, (_, truth) in zip(STARTS, each, strict=True)])
    )
    estimated.align(true, correct_scale=False)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((true, estimated))
    assert (row["n_robots"], row["n_team"], row["n"]) == (3, 3, 260)
    for name, value in ape.get_all_statistics().items():
        assert row[name] == pytest.approx(value, rel=1e-9), name


def test_the_fit_is_the_best_that_a_search_finds() -> None:
    rng = np.random.default_rng(5)
    each = [driven(rng, 40), driven(rng, 50)]
    T = se2.between(STARTS[0], STARTS[:2])
    T[1] += [0.3, -0.2, 0.05]
    row = final(team_rows(team_of(T, STARTS[:2]), paths_of(each)))
    path = np.concatenate([se2.compose(t, p) for t, (p, _) in zip(T, each, strict=True)])
    truth = np.concatenate([se2.compose(t, q) for t, (_, q) in zip(STARTS, each, strict=False)])

    def residual(pose: Float) -> Float:
        return (se2.compose(pose, path) - truth)[:, :2].ravel()

    found = least_squares(residual, STARTS[0], xtol=1e-14, ftol=1e-14)
    assert row["sse"] == pytest.approx(2 * found.cost, rel=1e-9)


def test_two_robots_apart_by_d_are_off_by_half_of_it() -> None:
    """Both drive the same cross, which leaves the fit no turn to trade for the shift."""
    arm = np.linspace(-2, 2, 41)
    cross = np.zeros((82, 3))
    cross[:41, 0], cross[41:, 1] = arm, arm
    starts, T = np.zeros((2, 3)), np.array([[0, 0, 0], [0.3, 0.4, 0.0]])
    row = final(team_rows(team_of(T, starts), paths_of([(cross, cross)] * 2)))
    assert [row["rmse"], row["max"]] == pytest.approx([0.25, 0.25])
    whole = final(team_rows(team_of(np.zeros((2, 3)), starts), paths_of([(cross, cross)] * 2)))
    assert whole["rmse"] == pytest.approx(0, abs=1e-12)


def test_smoothed_paths_are_moved_as_their_own_fuser_moved_the_maps() -> None:
    rng = np.random.default_rng(4)
    each = [driven(rng, 40), driven(rng, 50)]
    paths = paths_of(each)
    for name in NAMES:
        paths[f"smoothed_{name}"] = paths[f"truth_{name}"]
    T = se2.between(STARTS[0], STARTS[:2])
    papers = T + np.array([[0, 0, 0], [0.3, 0.4, 0.1]])

    def smoothed_m(T_first_smoothed: Float | None) -> float:
        rows = team_rows(team_of(papers, STARTS[:2]), paths, T_first_smoothed)
        (row,) = (row for row in rows if row["source"] == "smoothed")
        assert final(rows) == final(team_rows(team_of(papers, STARTS[:2]), paths))
        return row["rmse"]

    assert smoothed_m(T) == pytest.approx(0, abs=1e-9)
    assert smoothed_m(None) > 0.1
    alone = np.array([T[0], np.full(3, np.nan)])
    assert smoothed_m(alone) == smoothed_m(None), "merged other robots"


def test_each_set_of_robots_has_its_row_and_poses_without_truth_none() -> None:
    rng = np.random.default_rng(1)
    starts = np.concatenate([STARTS, STARTS + 1.0])[:5]
    each = [driven(rng, 30) for _ in range(5)]
    each[1][1][10:] = np.nan
    larger, smaller = np.full((2, 5, 3), np.nan)
    larger[:3] = se2.between(starts[0], starts[:3])
    smaller[3:] = se2.between(starts[3], starts[3:])
    rows = team_rows(team_of(np.array([larger, smaller]), starts), paths_of(each))
    first, second = final(rows, 1), final(rows, 2)
    assert (first["n_robots"], first["n"]) == (3, 70)
    assert (second["n_robots"], second["n"]) == (2, 60)


def test_nothing_merged_has_no_team_error() -> None:
    alone = np.full((3, 3), np.nan)
    alone[0] = 0.0
    team = team_of(alone, places=(EdgeStatus.REFUSED,) * 3)
    assert team_rows(team, paths_of([driven(np.random.default_rng(2), 9)] * 3)) == []


def errors_of(off_m: list[float], n_common: list[int], accepted: list[bool]) -> pd.DataFrame:
    """Rows of `errors` of all pairs at two iterations and of two aligners; the last ones count."""
    pairs = itertools.combinations(range(3), 2)
    rows = []
    for (a, b), off, n, ok in zip(pairs, off_m, n_common, accepted, strict=True):
        row = {"robot_a": f"R{a}", "robot_b": f"R{b}", "n_common": n, "accepted": ok}
        row |= {"refined_translation_error_m": off, "refined_rotation_error_rad": 0.01}
        for iteration, aligner, repetition in itertools.product((5, 7), ("ransac", "svd"), (0, 1)):
            used = (iteration, aligner, repetition) == (7, "ransac", 0)
            rows.append(
                row
                | {"iteration": iteration, "aligner": aligner, "repetition": repetition}
                | ({} if used else {"refined_translation_error_m": 99.0, "accepted": not ok})
            )
    return pd.DataFrame(rows)


def test_a_wrong_edge_is_told_before_and_what_the_team_makes_of_it_after() -> None:
    """R0-R1 and R0-R2 are right; R1-R2 is 3 m off, and the others contradict it."""
    T = se2.between(STARTS[0], STARTS)
    T[1] = se2.compose(T[1], [0.03, 0.04, 0.01])
    places = (EdgeStatus.CONFIRMED, EdgeStatus.CONFIRMED, EdgeStatus.CONTRADICTED)
    errors = errors_of([0.05, 0.0, 3.0], [40, 30, 20], [True, True, True])
    rows = team_pair_rows(team_of(T, places=places), errors, "ransac")
    assert rows["refined_translation_error_m"].tolist() == [0.05, 0.0, 3.0]
    for row in rows.to_dict("records"):
        a, b = (int(row[name][1:]) for name in ("robot_a", "robot_b"))
        matrices = [se2.between(T[a], T[b]), se2.between(STARTS[a], STARTS[b])]
        error = matrices[0] - matrices[1]
        assert row["team_translation_error_m"] == pytest.approx(math.hypot(*error[:2]))
        assert row["team_rotation_error_rad"] == pytest.approx(se2.wrap(error[2]))
    assert rows["team_translation_error_m"].iloc[0] == pytest.approx(0.05)
    assert rows["team_rotation_error_rad"].tolist() == pytest.approx([0.01, 0.0, -0.01])
    assert edge_precision(rows) == 1.0
    assert edge_recall(rows) == pytest.approx(2 / 3)
    rows.loc[2, "place"] = str(EdgeStatus.CONFIRMED)  # had it been believed
    assert edge_precision(rows) == pytest.approx(2 / 3)
    assert edge_recall(rows) == pytest.approx(2 / 3)


def test_recall_is_of_those_that_met_and_an_edge_without_common_ground_is_false() -> None:
    """R0-R1 met and were refused, R0-R2 are right by chance at best, R1-R2 met and are right."""
    places = (EdgeStatus.REFUSED, EdgeStatus.BRIDGE, EdgeStatus.BRIDGE)
    errors = errors_of([0.1, 0.1, 0.1], [3, 2, 50], [False, True, True])
    rows = team_pair_rows(team_of(se2.between(STARTS[0], STARTS), places=places), errors, "ransac")
    assert edge_precision(rows) == 0.5
    assert edge_recall(rows) == 0.5


def test_robots_in_no_map_together_have_no_error() -> None:
    T = np.full((3, 3), np.nan)
    T[:2] = se2.between(STARTS[0], STARTS[:2])
    rows = team_pair_rows(team_of(T), errors_of([0.1] * 3, [9] * 3, [True] * 3), "ransac")
    assert rows["team_translation_error_m"].isna().tolist() == [False, True, True]
    nothing = rows.assign(place=str(EdgeStatus.REFUSED), n_common=0)
    assert math.isnan(edge_precision(nothing))
    assert math.isnan(edge_recall(nothing))
