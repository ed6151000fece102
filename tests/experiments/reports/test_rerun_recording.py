"""What a Rerun recording is told, by a stand-in of the package, and the package where it is."""

import sys
from collections import defaultdict
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.pipeline.stages.align import alignment_of
from experiments.reports import rerun_recording
from experiments.reports.figures.result_tables import ResultTables, of_pair
from tests.helpers.tiny_scenario import assert_refused, command

Logged = dict[str, dict[int, Any]]  # by entity and frame


def stand_in(logged: Logged) -> ModuleType:
    """A module of that name that notes what is logged."""

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
    rerun_recording.write_rerun(ResultTables(tiny_result), tmp_path / "tiny.rrd")
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
    monkeypatch.setattr(rerun_recording, "find_spec", lambda _: None)
    reply = command(capsys, "export", tiny_result, "--format", "rerun", "-o", tmp_path / "out")
    assert_refused(reply, "rerun-sdk", "mapfusion[rerun]")
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
