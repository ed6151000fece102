"""Tests of the export of results."""

import json
import math
import sys
from collections import defaultdict
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from evo.core.geometry import umeyama_alignment
from evo.core.metrics import APE, PoseRelation
from evo.tools.file_interface import read_kitti_poses_file, read_tum_trajectory_file
from smfeval.cli.main import main as smfeval_main

from experiments.evaluation import tables
from experiments.pipeline.stages.align import alignment_of
from experiments.reports import result_export
from experiments.reports.figures.result_tables import ResultTables, of_pair
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import chi_square_bound
from mapfusion.landmark_map import read_map
from tests.helpers.tiny_scenario import assert_refused, command, without_tables

ROBOTS = ("R1", "R2", "R3")


def exported(capsys: pytest.CaptureFixture[str], result: Path, kind: str, folder: Path) -> Path:
    reply = command(capsys, "export", result, "--format", kind, "-o", folder)
    assert reply.code == 0, reply.err
    written = sorted(str(path) for path in folder.iterdir())
    assert sorted(reply.out.splitlines()) == written  # and no temporary file is left
    return folder


def words(path: Path) -> list[list[str]]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [line.split() for line in lines if not line.startswith("#")]


def poses_of(rows: pd.DataFrame, source: str) -> np.ndarray:
    return rows[[f"{source}_{name}" for name in ("x_m", "y_m", "theta_rad")]].to_numpy()


def read_tum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) and poses (T, 3)."""
    rows = np.array(words(path), dtype=np.float64)
    assert rows.shape[1] == 8
    assert (rows[:, [3, 4, 5]] == 0).all()
    np.testing.assert_allclose(np.hypot(rows[:, 6], rows[:, 7]), 1.0, atol=1e-15)
    return rows[:, 0], np.column_stack([rows[:, 1:3], 2 * np.arctan2(rows[:, 6], rows[:, 7])])


def assert_same_poses(found: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_array_equal(found[:, :2], expected[:, :2])
    np.testing.assert_allclose(se2.wrap(found[:, 2] - expected[:, 2]), 0, atol=1e-12)


def test_tum(trio_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = exported(capsys, trio_result, "tum", tmp_path / "out")
    data = ResultTables(trio_result)
    motions = data.table("fused_motions").set_index("robot")
    for robot in ROBOTS:
        paths = data.of_robot("paths", robot)
        times = data.of_robot("frame_times", robot)["time_s"].to_numpy()
        for source in ("final", "online", "odometry", "truth"):
            time_s, poses = read_tum(folder / f"{robot}.{source}.tum")
            np.testing.assert_array_equal(time_s, times)
            assert_same_poses(poses, poses_of(paths, source))
        start = data.start_pose(robot)
        assert start is not None
        _, poses = read_tum(folder / f"{robot}.world.tum")
        assert_same_poses(poses, se2.compose(start, poses_of(paths, "truth")))
        T = motions.loc[robot, ["tx_m", "ty_m", "theta_rad"]].to_numpy(dtype=float)
        assert (folder / f"{robot}.fused.tum").is_file() == np.isfinite(T).all()
        if np.isfinite(T).all():
            _, poses = read_tum(folder / f"{robot}.fused.tum")
            assert_same_poses(poses, se2.compose(T, poses_of(paths, "final")))
    assert np.all(np.diff(times) > 0)


def test_kitti_is_tum_with_the_axes_of_a_camera(
    trio_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = exported(capsys, trio_result, "kitti", tmp_path / "out")
    data = ResultTables(trio_result)
    for robot in ROBOTS:
        found = read_kitti_poses_file(folder / f"{robot}.final.kitti.txt")
        x, y, theta = poses_of(data.of_robot("paths", robot), "final").T
        # x right, y down, z ahead: what was left is -x, what was ahead is z
        np.testing.assert_allclose(found.positions_xyz, np.c_[-y, 0 * x, x], atol=1e-15)
        ahead = np.array(found.poses_se3)[:, :3, 2]
        np.testing.assert_allclose(ahead, np.c_[-np.sin(theta), 0 * x, np.cos(theta)], atol=1e-12)


def test_evo_says_of_the_files_what_the_table_says(
    trio_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Fitted in the plane: in space it may turn a path that is nearly straight over."""
    folder = exported(capsys, trio_result, "tum", tmp_path / "out")
    told = ResultTables(trio_result).table("path_statistics").query("quantity == 'ate_m'")
    assert len(told) == 12
    for row in told.to_dict("records"):
        truth, path = (
            read_tum_trajectory_file(folder / f"{row['robot']}.{which}.tum")
            for which in ("truth", row["source"])
        )
        R, t, _ = umeyama_alignment(path.positions_xyz[:, :2].T, truth.positions_xyz[:, :2].T)
        motion = np.eye(4)
        motion[:2, :2], motion[:2, 3] = R, t
        path.transform(motion)
        ape = APE(PoseRelation.translation_part)
        ape.process_data((truth, path))
        assert ape.get_all_statistics()["rmse"] == pytest.approx(row["rmse"], rel=1e-6)


def test_smfeval_scores_the_smoothed_path(
    trio_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its NEES is that of the planar positions, to first order in the error of the heading."""
    folder = exported(capsys, trio_result, "tum", tmp_path / "out")
    data = ResultTables(trio_result)
    for robot in ROBOTS:
        path, covariance = data.smoothed_path_of(robot)
        error = path - poses_of(data.of_robot("paths", robot), "truth")
        in_file = covariance[:, :2, :2] + 1e-8 * np.eye(2)  # 0.1 mm, see mapfusion docs export
        nees = nees_of(error[:, :2], in_file)
        files = (folder / f"{robot}.{name}" for name in ("smoothed.tum", "truth.tum"))
        options = ("--cov", folder / f"{robot}.smoothed.cov", "--align", "none", "--json")
        frames = ("--est-body-frame", "robot", "--ref-body-frame", "robot")
        assert score_of("nees", *files, *options, *frames) == 0
        verdict = json.loads(capsys.readouterr().out)
        assert verdict["n"] == len(path)
        assert verdict["median_nees"] == pytest.approx(np.median(nees), rel=0.01)
        # the file has the bound of three directions, of which the height has no error
        gate = chi_square_bound(0.9, 3)
        assert verdict["coverage"] == pytest.approx(np.mean(nees <= gate), abs=1.5 / len(path))


def score_of(*words: object) -> int:
    """Call smfeval's command line."""
    return smfeval_main([str(word) for word in words])


def nees_of(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])


def test_poses_that_are_not_known_are_left_out(
    trio_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tables.table_path(trio_copy, "paths")
    rows = tables.read(path, "paths")
    truth = [name for name in rows if name.startswith("truth")]
    gone = (rows["robot"] == "R1") & rows["iteration"].between(5, 9)
    rows.loc[gone | (rows["robot"] == "R2"), truth] = math.nan
    tables.write(path, "paths", rows)
    folder = exported(capsys, trio_copy, "tum", tmp_path / "out")
    assert len(words(folder / "R1.truth.tum")) == len(words(folder / "R1.final.tum")) - 5
    assert not (folder / "R2.truth.tum").exists()
    assert not (folder / "R2.world.tum").exists()


class Graph:
    """A g2o file, and the errors and weights of its edges as g2o defines them."""

    def __init__(self, path: Path) -> None:
        self.pose: dict[int, np.ndarray] = {}
        self.point: dict[int, np.ndarray] = {}
        self.motions: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        self.sightings: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        for kind, *rest in words(path):
            if kind == "VERTEX_SE2":
                self.pose[int(rest[0])] = np.array(rest[1:], float)
            elif kind == "VERTEX_XY":
                self.point[int(rest[0])] = np.array(rest[1:], float)
            else:
                size, edges = (3, self.motions) if kind == "EDGE_SE2" else (2, self.sightings)
                assert kind in ("EDGE_SE2", "EDGE_SE2_XY")
                numbers = np.array(rest[2:], float)
                weight = np.zeros((size, size))
                weight[np.triu_indices(size)] = numbers[size:]
                weight = np.triu(weight) + np.triu(weight, 1).T
                edges[int(rest[0]), int(rest[1])] = numbers[:size], weight

    @staticmethod
    def matrix(pose: np.ndarray) -> np.ndarray:
        x, y, theta = pose
        c, s = math.cos(theta), math.sin(theta)
        return np.array([[c, -s, x], [s, c, y], [0, 0, 1]])

    def squared(self, i: int, j: int, X_i: np.ndarray, X_j: np.ndarray) -> float:
        """e' W e of e = Z^-1 (X_i^-1 X_j)."""
        Z, weight = self.motions[i, j]
        E = np.linalg.inv(self.matrix(Z)) @ np.linalg.inv(self.matrix(X_i)) @ self.matrix(X_j)
        e = np.array([E[0, 2], E[1, 2], math.atan2(E[1, 0], E[0, 0])])
        return float(e @ weight @ e)


@pytest.fixture
def graph(trio_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Graph:
    return Graph(exported(capsys, trio_result, "g2o", tmp_path / "out") / "team.g2o")


def test_g2o_holds_paths_and_maps_in_the_order_of_the_keys(graph: Graph, trio_result: Path) -> None:
    data, key = ResultTables(trio_result), 0
    motions = data.table("fused_motions").set_index("robot")
    for robot in ROBOTS:
        T = motions.loc[robot, ["tx_m", "ty_m", "theta_rad"]].fillna(0.0).to_numpy(dtype=float)
        poses = se2.compose(T, poses_of(data.of_robot("paths", robot), "final"))
        own = read_map(trio_result / "maps" / f"{robot}.parquet")
        first = key
        for pose in poses:
            np.testing.assert_array_equal(graph.pose[key], pose)
            key += 1
        for p, S, placed in zip(
            own.position_m, own.covariance_m2, se2.transform_points(T, own.position_m), strict=True
        ):
            np.testing.assert_array_equal(graph.point[key], placed[:2])
            seen, weight = graph.sightings[first, key]
            np.testing.assert_array_equal(seen, p[:2])
            np.testing.assert_allclose(weight @ S[:2, :2], np.eye(2), atol=1e-6)
            key += 1
    assert key == len(graph.pose) + len(graph.point)


def test_g2os_odometry_chains_to_the_tables(graph: Graph, trio_result: Path) -> None:
    data, first = ResultTables(trio_result), 0
    for robot in ROBOTS:
        odometry = poses_of(data.of_robot("paths", robot), "odometry")
        at = np.zeros(3)
        for k in range(1, len(odometry)):
            Z, weight = graph.motions[first + k - 1, first + k]
            at = se2.compose(at, Z)
            np.testing.assert_allclose(at[:2], odometry[k, :2], atol=1e-9)
            assert np.linalg.eigvalsh(weight).min() > 0
            assert np.linalg.eigvalsh(weight).max() <= 1.001e8  # 0.1 mm, 0.1 mrad
        first += len(odometry) + len(read_map(trio_result / "maps" / f"{robot}.parquet"))


def test_g2os_weights_are_mahalanobis_distances_in_the_frame_of_a(
    graph: Graph, trio_result: Path
) -> None:
    """An edge with error d has the cost d' S^-1 d, with S as in `estimates`."""
    data = ResultTables(trio_result)
    sizes = [
        len(data.of_robot("paths", robot)) + len(read_map(trio_result / f"maps/{robot}.parquet"))
        for robot in ROBOTS
    ]
    first = dict(zip(ROBOTS, np.cumsum([0, *sizes[:2]]).tolist(), strict=True))
    estimates = data.table("estimates").query("aligner == 'ransac' and repetition == 0")
    edges = data.table("team_edges")
    believed = edges[edges["place"].isin(["confirmed", "bridge"])]
    assert len(believed)
    for a, b in believed[["robot_a", "robot_b"]].itertuples(index=False):
        row = estimates[(estimates["robot_a"] == a) & (estimates["robot_b"] == b)].iloc[-1]
        T = row[["refined_tx_m", "refined_ty_m", "refined_theta_rad"]].to_numpy(dtype=float)
        np.testing.assert_array_equal(graph.motions[first[a], first[b]][0], T)
        xx, xy, xt, yy, yt, tt = row[[f"cov_{n}" for n in ("xx", "xy", "xt", "yy", "yt", "tt")]]
        S = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
        for d in np.random.default_rng(0).normal(0, np.sqrt([xx, yy, tt]), (5, 3)):
            X_a = np.array([3.0, -1.0, 0.7])
            found = graph.squared(first[a], first[b], X_a, se2.compose(X_a, T + d))
            assert found == pytest.approx(d @ np.linalg.solve(S, d), rel=1e-6)
    across = {(i, j) for i, j in graph.motions if j != i + 1}  # all others are along paths
    pairs = believed[["robot_a", "robot_b"]].itertuples(index=False)
    assert across == {(first[a], first[b]) for a, b in pairs}


def read_ply(path: Path) -> pd.DataFrame:
    header, _, body = path.read_text(encoding="utf-8").partition("end_header\n")
    lines = [line.split() for line in header.splitlines()]
    assert lines[:2] == [["ply"], ["format", "ascii", "1.0"]]
    (n,) = (int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
    names = [line[2] for line in lines if line[0] == "property"]
    rows = [line.split() for line in body.splitlines()]
    assert len(rows) == n
    return pd.DataFrame(rows, columns=pd.Index(names), dtype=float)


def test_ply(trio_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = exported(capsys, trio_result, "ply", tmp_path / "out")
    data = ResultTables(trio_result)
    files = sorted(path.stem for path in (trio_result / "maps").iterdir())
    maps = [name for name in files if not name.endswith((".joint", ".viewing", ".frames"))]
    assert {*ROBOTS, "fused", "R1.smoothed"} <= set(maps) < set(files)
    assert sorted(path.stem for path in folder.iterdir()) == maps
    for name in maps:
        cloud, own = (
            read_ply(folder / f"{name}.ply"),
            read_map(trio_result / f"maps/{name}.parquet"),
        )
        np.testing.assert_array_equal(cloud[["x", "y", "z"]], own.position_m)
        variance = own.covariance_m2[:, [0, 1, 2], [0, 1, 2]]
        np.testing.assert_array_equal(cloud[["cov_xx_m2", "cov_yy_m2", "cov_zz_m2"]], variance)
        np.testing.assert_array_equal(cloud["count"], own.count)
        colours = [f"#{int(r):02X}{int(g):02X}{int(b):02X}" for r, g, b in colours_of(cloud)]
        if name.partition(".")[0] in ROBOTS:
            assert set(colours) == {data.colours[name.partition(".")[0]]}
    fused = data.table("fused_map")
    cloud = colours_of(read_ply(folder / "fused.ply"))
    black = (cloud == 0).all(axis=1)
    np.testing.assert_array_equal(black, fused["n_parents"].to_numpy() > 1)
    for robot in fused["robot_a"].unique():
        own = cloud[((fused["robot_a"] == robot) & (fused["n_parents"] == 1)).to_numpy()]
        assert {tuple(rgb) for rgb in own.astype(int).tolist()} <= {rgb_of(data.colours[robot])}


def colours_of(cloud: pd.DataFrame) -> np.ndarray:
    return cloud[["red", "green", "blue"]].to_numpy()


def rgb_of(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:], 16)


def test_bad_input_is_one_line_and_writes_nothing(
    trio_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(result: Path, kind: str, *said: str) -> None:
        assert_refused(
            command(capsys, "export", result, "--format", kind, "-o", tmp_path / "out"), *said
        )
        assert not (tmp_path / "out").exists()

    refused(trio_copy, "obj", "--format obj: unknown; known: tum, kitti, g2o, ply")
    refused(tmp_path / "none", "tum", "not a result folder")
    assert_refused(command(capsys, "export", trio_copy), "--format")
    without_tables(trio_copy, "frame_times")
    refused(trio_copy, "tum", "holds no times of frames; run it again")
    (trio_copy / "maps" / "R3.parquet").write_bytes(b"none")
    refused(trio_copy, "ply", "R3.parquet")
    for name in ("robots", "paths"):
        path = tables.table_path(trio_copy, name)
        rows = tables.read(path, name).replace({"R2": "../R2"})
        tables.write(path, name, rows)
    refused(trio_copy, "g2o", "robot is named '../R2'")


Logged = dict[str, dict[int, Any]]  # by entity and frame


def stand_in(logged: Logged) -> ModuleType:
    """Module of that name that records the calls."""

    class Stream:
        def __init__(self, *_: object, **__: object) -> None:
            self.frame = -1

        def save(self, path: Path) -> None:
            path.write_bytes(b"RRF2")

        def set_time(self, _: str, *, sequence: int) -> None:
            self.frame = sequence

        def log(self, where: str, entity: Any) -> None:
            logged[where][self.frame] = entity

        def __getattr__(self, _: str) -> Any:
            return lambda *_, **__: None

    made: Any = ModuleType("rerun")
    made.__spec__, made.RecordingStream = ModuleSpec("rerun", None), Stream
    made.Points3D = made.LineStrips3D = made.Points2D = lambda what, **_: what
    made.EncodedImage = lambda contents, **_: SimpleNamespace(png=contents)
    return made


@pytest.fixture
def logged(tiny_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Logged:
    found: Logged = defaultdict(dict)
    monkeypatch.setitem(sys.modules, "rerun", stand_in(found))
    result_export.write_rerun(ResultTables(tiny_result), tmp_path / "tiny.rrd")
    assert (tmp_path / "tiny.rrd").read_bytes() == b"RRF2"
    return found


def test_pictures_have_their_features(logged: Logged, tiny_result: Path) -> None:
    tracks = ResultTables(tiny_result).table("tracks")
    files = sorted((tiny_result / "keyframes").glob("R1_*.png"))
    assert files
    for path in files:
        k = int(path.stem[3:])
        assert logged["images/R1"][k].png.startswith(b"\x89PNG")
        n = len(tracks[(tracks["robot"] == "R1") & (tracks["iteration"] == k)])
        assert logged["images/R1/features"][k].shape == (n, 2)


def test_maps_paths_and_particles_are_those_of_the_tables(
    logged: Logged, tiny_result: Path
) -> None:
    data = ResultTables(tiny_result)
    last = max(logged["robots/R1/map"])
    expected, _ = data.landmarks_of("R1")
    np.testing.assert_allclose(logged["robots/R1/map"][last][:, :2], expected[:, :2], atol=1e-6)
    (path,) = logged["robots/R1/path"][last]
    np.testing.assert_array_equal(path[:, :2], data.path_of("R1"))
    clouds = data.of_robot("clouds", "R1")
    assert sum(map(len, logged["robots/R1/particles"].values())) == len(clouds)
    fused = [name for name in logged if name.startswith("fused/") and name != "fused/walls"]
    assert sum(len(logged[name][last]) for name in fused) == len(data.fused_map())


def test_correspondences_join_what_the_alignment_says_is_one(
    logged: Logged, tiny_result: Path
) -> None:
    data = ResultTables(tiny_result)
    rows = of_pair(data.table("estimates"), ("R1", "R2"))
    used = (rows["aligner"] == data.scenario["merge"]["aligner"]) & (rows["repetition"] == 0)
    accepted = {}
    for row in rows[used].to_dict("records"):
        found = alignment_of(row, int(row["n_correspondences"]))
        if found.ok:
            accepted[int(row["iteration"])] = int(found.inlier.sum())
    lines = logged["pairs/R1-R2/correspondences"]
    assert {k: len(each) for k, each in lines.items()} == accepted
    assert accepted
    for strips in lines.values():
        length_m = np.linalg.norm(np.diff(np.array(strips), axis=1), axis=2)
        assert length_m.max() < 0.5  # the refinement's gate


def test_without_the_package_it_is_one_line(
    tiny_result: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(result_export, "find_spec", lambda _: None)
    reply = command(capsys, "export", tiny_result, "--format", "rerun", "-o", tmp_path / "out")
    assert_refused(reply, "rerun-sdk", "mapfusion-bench[rerun]")
    assert not (tmp_path / "out").exists()


def test_the_package_writes_a_recording(
    tiny_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun")
    reply = command(capsys, "export", tiny_result, "--format", "rerun", "-o", tmp_path)
    assert reply.code == 0, reply.err
    (path,) = tmp_path.iterdir()
    assert path.name == "tiny-3.rrd"
    data = path.read_bytes()
    assert data.startswith(b"RRF")
    for entity in (b"/images/R1/features", b"/robots/R2/particles", b"/pairs/R1-R2", b"/fused"):
        assert entity in data
