"""Tests of pose graphs of several robots: grids of poses, two metres apart, with known noise."""

import itertools
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapfusion.errors import InputError
from mapfusion.exchange import G2oGraph, PlanarPoseGraph, read_pose_graph
from mapfusion.fusion.team_graph import EdgeStatus
from mapfusion.fusion.team_pose_graph import NoiseFactors, judge_pose_graph
from mapfusion.geometry import se2

SIGMA_M, SIGMA_RAD = 0.2, 0.01
SIDE, STEP_M = 3, 2.0
LETTER_BITS = 56
UNIT_INFORMATION = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"


def key_of(place: tuple[int, ...], robots_across: int) -> tuple[str, int]:
    """Robot of a place of the grid, and key of its pose."""
    letter = chr(ord("a") + place[0] // SIDE * robots_across + place[1] // SIDE)
    return letter, (ord(letter) << LETTER_BITS) + place[0] * 100 + place[1] * 10 + place[2]


def write_grid(folder: Path, robots_across: int, seed: int, wrong: int = 0) -> list[str]:
    """Write one file for each robot, as public graphs have it; the first motions may be wrong.

    Motions between robots are in the files of both. Returns the robots' names.
    """
    rng, lines = np.random.default_rng(seed), dict[str, list[str]]()
    n, n_between = SIDE * robots_across, 0
    places = list(itertools.product(range(n), range(n), range(2)))
    for place in places:
        robot, key = key_of(place, robots_across)
        x, y, z = STEP_M * np.array(place)
        lines.setdefault(robot, []).append(f"VERTEX_SE3:QUAT {key} {x} {y} {z} 0 0 0 1")
    for place, ahead in itertools.product(places, np.eye(3, dtype=int)):
        to = tuple((np.array(place) + ahead).tolist())
        if to not in places:
            continue
        (a, i), (b, j) = key_of(place, robots_across), key_of(to, robots_across)
        moved = STEP_M * ahead + rng.normal(0, SIGMA_M, 3)
        turn = Rotation.from_rotvec(rng.normal(0, SIGMA_RAD, 3)).as_quat()
        n_between += a != b
        if a != b and n_between <= wrong:
            moved += [1.5, -2.0, 0.0]
        numbers = " ".join(map(str, [*moved.tolist(), *turn.tolist()]))
        for robot in {a, b}:
            lines[robot].append(f"EDGE_SE3:QUAT {i} {j} {numbers} {UNIT_INFORMATION}")
    for k, robot in enumerate(sorted(lines)):
        (folder / f"{k}.g2o").write_text("\n".join(lines[robot]) + "\n")
    return sorted(lines)


def grid(folder: Path, robots_across: int, seed: int, wrong: int = 0) -> PlanarPoseGraph:
    write_grid(folder, robots_across, seed, wrong)
    return read_pose_graph(sorted(folder.glob("*.g2o")))


def test_all_robots_are_placed_and_the_noise_is_found(tmp_path: Path) -> None:
    judged = judge_pose_graph(grid(tmp_path, 3, seed=0))
    assert judged.robots == tuple("abcdefghi")
    assert len(judged.edges) == 12 * SIDE * 2  # borders between robots
    assert judged.is_kept.all()
    assert not judged.component.any()
    assert judged.noise is not None
    assert judged.noise.translation == pytest.approx(SIGMA_M, rel=0.1)
    assert judged.noise.rotation == pytest.approx(SIGMA_RAD, rel=0.15)
    # each robot's frame is its corner of the grid
    corners = STEP_M * SIDE * np.array(list(itertools.product(range(3), range(3))))
    off = judged.T_root_robot[:, :2] - corners
    assert np.abs(off).max() < 4 * SIGMA_M
    assert np.abs(judged.T_root_robot[:, 2]).max() < 5 * SIGMA_RAD


def test_motions_that_contradict_the_others_are_refused(tmp_path: Path) -> None:
    wrong = 2
    judged = judge_pose_graph(grid(tmp_path, 2, seed=1, wrong=wrong))
    off = judged.edges.T_a_b[:, :2] - STEP_M * SIDE * np.array([0, 1])
    is_wrong = (np.abs(off - [1.5, -2.0]) < 5 * SIGMA_M).all(axis=1)
    assert np.count_nonzero(is_wrong) == wrong
    assert set(judged.status[is_wrong]) == {EdgeStatus.CONTRADICTED}
    assert judged.is_kept[~is_wrong].all()


def test_squared_distances_are_of_the_size_that_their_degrees_of_freedom_tell(
    tmp_path: Path,
) -> None:
    """Below 1 on average: measured alignments of two robots share errors of the paths."""
    found = []
    for seed in range(8):
        folder = tmp_path / str(seed)
        folder.mkdir()
        found.append(judge_pose_graph(grid(folder, 2, seed)).nees_per_dof)
    assert 0.5 < np.mean(found) < 1.2


def test_alignments_as_often_contradicted_as_confirmed_are_ambiguous(tmp_path: Path) -> None:
    judged = judge_pose_graph(grid(tmp_path, 2, seed=2, wrong=3))
    (robots, count) = np.unique(judged.edges.robots, axis=0, return_counts=True)
    assert (count == SIDE * 2).all()
    disputed = (judged.edges.robots == robots[0]).all(axis=1)
    assert set(judged.status[disputed]) == {EdgeStatus.AMBIGUOUS}
    assert judged.is_kept[~disputed].all()


def test_a_grid_of_stated_noise_keeps_it(tmp_path: Path) -> None:
    graph = grid(tmp_path, 2, seed=0)
    judged = judge_pose_graph(graph, estimate_noise=False)
    assert judged.noise == NoiseFactors(1.0, 1.0)
    assert judged.nees_per_dof < 0.1  # it is a fifth and a hundredth of the stated


def test_an_alignment_is_the_motion_between_first_poses(tmp_path: Path) -> None:
    """Two robots that drive straight, and one motion between their second poses."""
    graph, S = G2oGraph(), np.diag([0.01, 0.04, 0.0009])
    T_a = np.array([[0.0, 0, 0], [1, 0, 0.5], [2, 1, 1.0]])
    T_b = np.array([[0.0, 0, 0], [0, 2, -0.3], [1, 2, -0.3]])
    rows = []
    for name, path in (("R1", T_a), ("R2", T_b)):
        graph.add_comment(f"{name}, in its own frame: poses, one a frame; then landmarks")
        rows.append(graph.add_poses(path))
        motions = se2.between(path[:-1], path[1:])
        for i, j, motion in zip(rows[-1][:-1], rows[-1][1:], motions, strict=True):
            graph.add_motion(int(i), int(j), motion, S)
    T_i_j = np.array([0.7, -0.2, 0.9])
    graph.add_motion(int(rows[0][1]), int(rows[1][1]), T_i_j, S)
    path = tmp_path / "team.g2o"
    path.write_text(graph.text())
    judged = judge_pose_graph(read_pose_graph([path]))
    assert judged.robots == ("R1", "R2")
    assert judged.noise is None  # no loops
    T_a_b = se2.compose(se2.compose(T_a[1], T_i_j), se2.inverse(T_b[1]))
    np.testing.assert_allclose(judged.edges.T_a_b, [T_a_b], atol=1e-12)
    assert judged.status.tolist() == [EdgeStatus.BRIDGE]
    # the covariance against draws
    rng, draws = np.random.default_rng(0), []
    for _ in range(20_000):
        a, b, measured = (
            T + np.linalg.cholesky(S) @ rng.standard_normal(3)
            for T in (se2.between(T_a[0], T_a[1]), se2.between(T_b[0], T_b[1]), T_i_j)
        )
        draws.append(se2.compose(se2.compose(a, measured), se2.inverse(b)))
    np.testing.assert_allclose(judged.edges.covariance[0], np.cov(np.array(draws).T), atol=0.02)


def test_a_planar_graph_is_read_alike_in_both_kinds_of_lines(tmp_path: Path) -> None:
    information = np.diag([4.0, 25.0, 100.0])
    information[0, 1] = information[1, 0] = 2.0
    plane = [f"VERTEX_SE2 {(ord(c) << LETTER_BITS)} 0 0 0" for c in "ab"]
    space = [f"VERTEX_SE3:QUAT {(ord(c) << LETTER_BITS)} 0 0 0 0 0 0 1" for c in "ab"]
    ends = f"{ord('a') << LETTER_BITS} {ord('b') << LETTER_BITS}"
    upper = " ".join(map(str, information[np.triu_indices(3)]))
    plane.append(f"EDGE_SE2 {ends} 1 2 0.7 {upper}")
    larger = np.eye(6)
    larger[np.ix_([0, 1, 5], [0, 1, 5])] = information
    upper = " ".join(map(str, larger[np.triu_indices(6)]))
    turn = " ".join(map(str, Rotation.from_euler("z", 0.7).as_quat()))
    space.append(f"EDGE_SE3:QUAT {ends} 1 2 0 {turn} {upper}")
    read = []
    for name, lines in (("plane", plane), ("space", space)):
        (tmp_path / name).write_text("\n".join(lines))
        read.append(read_pose_graph([tmp_path / name]))
    np.testing.assert_allclose(read[0].T_i_j, read[1].T_i_j, atol=1e-12)
    np.testing.assert_allclose(read[0].covariance, read[1].covariance, atol=1e-12)
    R = se2.rotation(0.7)
    S = np.linalg.inv(information)[:2, :2]
    np.testing.assert_allclose(read[0].covariance[0, :2, :2], R @ S @ R.T, atol=1e-12)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("VERTEX_SE2 3 0 0 0", "line 1: the key of the pose names no robot"),
        ("VERTEX_SE2 x 0 0 0", "line 1: "),
        ("# R1,\nVERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0", "line 3: expected 9 finite"),
        ("# R1,\nVERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 -1", "not positive definite"),
        (f"EDGE_SE3:QUAT 0 1 0 0 0 0.7 0 0 0.7 {UNIT_INFORMATION}", "tilts by more than 10"),
        ("nothing of g2o", "has no poses"),
    ],
)
def test_a_damaged_graph_is_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "g.g2o"
    path.write_text(line + "\n")
    with pytest.raises(InputError, match=message) as raised:
        read_pose_graph([path])
    assert str(path) in str(raised.value)


def test_one_robot_is_no_team(tmp_path: Path) -> None:
    write_grid(tmp_path, 2, seed=0)
    graph = read_pose_graph([tmp_path / "0.g2o"])
    assert graph.n_left_out == 2 * SIDE * 2  # motions to two neighbours
    with pytest.raises(ValueError, match="two robots or more"):
        judge_pose_graph(graph)


@pytest.mark.skipif(
    "MAPFUSION_DISTRIBUTED_MAPPER" not in os.environ,
    reason="MAPFUSION_DISTRIBUTED_MAPPER: folder `data` of the package distributed-mapper",
)
def test_public_graphs() -> None:
    folders = Path(os.environ["MAPFUSION_DISTRIBUTED_MAPPER"]).glob("example_*robots")
    for folder in folders:
        files = [path for path in folder.glob("*.g2o") if path.stem.isdigit()]
        judged = judge_pose_graph(read_pose_graph(sorted(files)))
        assert len(judged.robots) == len(files)
        assert not judged.component.any()
        assert judged.is_kept.mean() > 0.95
        assert judged.noise is None or 0.3 < judged.nees_per_dof < 1.5
