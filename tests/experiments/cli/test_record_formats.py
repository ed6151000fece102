"""A simulated run in the layouts of others, imported again: the same log, and the same map."""

from pathlib import Path

import numpy as np
import pytest

from mapfusion.landmark_map import read_map
from mapfusion.robot_log import read_log
from tests.helpers.tiny_scenario import SHORT, assert_refused, command

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
    assert_refused(reply, "--format mp4", "log, euroc, kitti, rosbag")
    assert not (tmp_path / "out").exists()
