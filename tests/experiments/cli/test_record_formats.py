"""A simulated run in the layouts of others, imported again: the same log, and the same map."""

from pathlib import Path

import numpy as np
import pytest

import mapfusion
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import chi_square_bound
from mapfusion.landmark_map import read_map
from mapfusion.robot_log import read_log, read_true_poses
from tests.helpers.tiny_scenario import SHORT, TINY, assert_refused, command

BAG = ("--left", "/left/image_rect", "--right", "/right/image_rect", "--odom", "/odom")
OWN = {
    "kitti": ("R1", ("--param", "mount.x_m=0.15", "--param", "mount.z_m=0.45")),
    "euroc": ("R1", ()),
    "rosbag": ("R1.bag", BAG),
    "rosbag2": ("R1.ros2", BAG),
}


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("record") / "short.yaml"
    path.write_text(SHORT)
    return path


def record(capsys: pytest.CaptureFixture[str], scenario: Path, name: str) -> Path:
    """The folder that a run was recorded into; the store is shared."""
    folder, results = scenario.parent / name, scenario.parent / "results"
    if not folder.exists():
        own = ("-o", folder, "--results", results, "--jobs", 1, "--format", name)
        reply = command(capsys, "record", scenario, *own)
        assert reply.code == 0, reply.err
        assert "2 written" in reply.out
    return folder


@pytest.mark.parametrize("name", list(OWN))
def test_a_round_trip_changes_nothing(
    name: str, scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = read_log(record(capsys, scenario, "log") / "R1")
    written, given = OWN[name]
    path, logs = record(capsys, scenario, name) / written, tmp_path / "logs"
    reply = command(
        capsys, "import", name.removesuffix("2"), path, "-o", logs, "--scenario", scenario, *given
    )
    assert reply.code == 0, reply.err
    found = read_log(logs / "R1")
    np.testing.assert_allclose(found.time_s, own.time_s, atol=1e-6)
    np.testing.assert_allclose(found.odometry, own.odometry, atol=1e-12)
    np.testing.assert_array_equal(found.iteration, own.iteration)
    assert len(found.observations) > 20
    position = found.observations.position_m
    np.testing.assert_allclose(position, own.observations.position_m, atol=1e-12)
    np.testing.assert_array_equal(found.observations.descriptor, own.observations.descriptor)

    maps = []
    for log in (scenario.parent / "log" / "R1", logs / "R1"):
        out = tmp_path / f"{len(maps)}.parquet"
        assert command(capsys, "slam", log, "-o", out, "--scenario", scenario).code == 0
        maps.append(read_map(out))
    assert len(maps[0]) == len(maps[1]) > 0
    np.testing.assert_allclose(maps[1].position_m, maps[0].position_m, atol=1e-9)


def test_an_unknown_format_is_one_line(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = command(capsys, "record", scenario, "-o", tmp_path / "out", "--format", "mp4")
    assert_refused(reply, "--format mp4", "log, euroc, kitti, tum_rgbd")
    assert not (tmp_path / "out").exists()


def test_maps_and_motions_by_depth_are_those_by_stereo(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Errors of maps and of the motion between them are those that the covariances state."""
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    given, maps = ("--scenario", path, "--jobs", 1), {}
    for name in ("euroc", "tum_rgbd"):
        own = ("-o", tmp_path / name, "--results", tmp_path / "results", "--jobs", 1)
        assert command(capsys, "record", path, *own, "--format", name).code == 0
        robots, logs = [tmp_path / name / robot for robot in ("R1", "R2")], tmp_path / "logs" / name
        reply = command(capsys, "import", name, *robots, "-o", logs, *given)
        assert reply.code == 0, reply.err
        for robot in ("R1", "R2"):
            out = tmp_path / f"{name}-{robot}.parquet"
            reply = command(capsys, "slam", logs / robot, "-o", out, "--scenario", path)
            assert reply.code == 0, reply.err
            maps[name, robot] = read_map(out.with_suffix(".smoothed.parquet"))

    starts = [read_true_poses(tmp_path / "logs" / "tum_rgbd" / robot)[0] for robot in ("R1", "R2")]
    for name in ("euroc", "tum_rgbd"):
        found = mapfusion.align_maps(maps[name, "R1"], maps[name, "R2"], aligner="clique")
        assert found.inlier.sum() > 30
        off = found.T_a_b - se2.between(*starts)
        assert off @ np.linalg.solve(found.covariance, off) < chi_square_bound(0.999, 3)
    for robot in ("R1", "R2"):  # both maps are in the frame of the robot's first pose
        both = mapfusion.align_maps(maps["euroc", robot], maps["tum_rgbd", robot], aligner="clique")
        assert both.inlier.sum() > 40
        assert se2.rms_distance_m(both.T_a_b, np.zeros(3), both.map_b.position_m[:, :2]) < 0.05
