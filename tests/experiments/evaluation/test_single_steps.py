"""Maps of the user's own, whatever the order in which the command names them."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation.single_steps import align, alignment_row, merge
from experiments.pipeline.tables import COVARIANCE
from experiments.scenario.loading import default_settings
from mapfusion.align.alignment import Pairs
from mapfusion.align.icp import Icp
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import read_map, write_map
from tests.helpers.made_up_maps import landmark_map
from tests.helpers.tiny_scenario import assert_refused, command
from tests.mapfusion.align.map_pairs import unit_vectors
from tests.mapfusion.robots_of_one_world import Robots
from tests.mapfusion.same_fusion import assert_same_points

# m and rad: the iterations of joint fusion end a thirtieth of a sigma before they stand still
WITHIN = 3e-3


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    """Four overlapping maps with drift, of which RANSAC draws."""
    robots = Robots([slice(40 * k, 40 * k + 120) for k in range(4)], drift_m=0.05)
    files = [tmp_path / f"map {k}.parquet" for k in range(4)]
    for path, landmarks in zip(files, robots.maps, strict=True):
        write_map(path, landmarks)
    return files


def test_the_order_of_the_files_changes_nothing_but_the_frame(paths: list[Path]) -> None:
    settings = default_settings(["merge.aligner=ransac"], 0)
    one = merge(paths, settings).fusion.fused[0]
    assert len(one.members) == 4
    orders = list(itertools.permutations(range(4)))
    for place in np.random.default_rng(0).choice(len(orders), 4, replace=False):
        order = orders[place]
        two = merge([paths[k] for k in order], settings).fusion.fused[0]
        assert_same_points(one, two, order, WITHIN)


def test_a_call_that_is_timed_finds_nothing_of_the_one_before(
    paths: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    found, given = Icp.find, list[Pairs]()

    def find(method: Icp, pairs: Pairs, rng: np.random.Generator) -> object:
        given.append(pairs)  # which keep what helps a later call on the same
        return found(method, pairs, rng)

    monkeypatch.setattr(Icp, "find", find)
    rows = align(paths[0], paths[1], default_settings([], 0))
    assert {row.aligner for row in rows} >= {"icp", "ransac"}
    first, timed = given
    assert first is not timed


def described_map(path: Path, position_m: Float, look: Float) -> None:
    write_map(path, replace(landmark_map(position_m, path.stem), descriptor=look))


@pytest.fixture
def described(tmp_path: Path) -> list[Path]:
    """Maps a and b of the same points with descriptors, and c, the mirror image of b."""
    rng = np.random.default_rng(0)
    p, look = rng.uniform(-6, 6, (60, 3)) * [1, 1, 0.1], unit_vectors(rng, 60)
    moved = se2.transform_points(np.array([1.0, -2.0, 0.3]), p)
    paths = [tmp_path / f"{name}.parquet" for name in "abc"]
    for path, position in zip(paths, (p, moved, moved * [1, -1, 1]), strict=True):
        described_map(path, position, look)
    return paths


ONE = ("--aligner", "ransac")


def test_a_merge_tells_that_no_evidence_could_be_sought(
    described: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b, _ = described
    told = command(capsys, "merge", a, b, *ONE, "-o", tmp_path / "f.parquet").out.splitlines()
    note = "another place that looks alike could not be ruled out: map a has no viewing evidence"
    assert note in told[-1]
    assert "a and b are the same map" in told[-1]
    assert not any("evidence" in line for line in told[:-1])
    assert note in command(capsys, "align", a, b, *ONE).out


def test_a_failed_aligner_is_named(
    described: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own.py"
    own.write_text("class Odd:\n    randomised = False\n    def find(self, pairs, rng): 1 / 0\n")
    maps = ("merge", *described[:2], "-o", tmp_path / "f.parquet", "--aligner", f"{own}:Odd")
    reply = command(capsys, *maps)
    assert reply.code == 1
    assert "a and b: Odd: failed: raised ZeroDivisionError" in reply.out


def test_a_mirrored_map_is_named_once_and_no_other(
    described: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b, c = described
    note = "a and c look like mirror images of each other: check the signs of y and theta"
    assert command(capsys, "align", a, c, "--aligner", "ransac", "--aligner", "gnc").out.count(
        note
    ) == (1)
    merged = command(capsys, "merge", a, c, *ONE, "-o", tmp_path / "f.parquet")
    assert merged.code == 1
    assert merged.out.count(note) == 1
    assert "mirror" not in command(capsys, "align", a, b, *ONE).out
    rng = np.random.default_rng(1)
    described_map(tmp_path / "other.parquet", rng.uniform(-6, 6, (60, 3)), unit_vectors(rng, 60))
    assert "mirror" not in command(capsys, "align", a, tmp_path / "other.parquet", *ONE).out


def test_accepted_estimates_can_be_required(
    described: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    a, b, c = described
    assert command(capsys, "align", a, b, *ONE, "--require-accepted").code == 0
    assert command(capsys, "align", a, c, *ONE).code == 0
    for more in ((), ("--json",)):
        reply = command(capsys, "align", a, c, *ONE, "--require-accepted", *more)
        assert reply.code == 1
        assert reply.complaints == [f"mapfusion: {a} and {c}: no estimate of T_a_b is accepted"]


def test_descriptors_of_different_kinds_are_refused_once(
    described: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    a, b, _ = described
    landmarks = read_map(b)
    bits = np.random.default_rng(0).integers(0, 256, (len(landmarks), 32)).astype(np.uint8)
    write_map(b, replace(landmarks, descriptor=bits, descriptor_kind=None))
    said = (f"{b} has descriptors of another kind (hamming, 256 bits) than {a}", "(usurf)")
    for words in (("align", a, b), ("merge", a, b, "-o", b.with_name("f.parquet"))):
        assert_refused(command(capsys, *words), *said)


def test_the_metric_of_a_csv_is_stated_by_an_option(
    described: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    bits = np.random.default_rng(0).integers(0, 256, (60, 32)).astype(np.uint8)
    paths = []
    for path in described[:2]:
        landmarks = replace(read_map(path), descriptor=None)
        table = landmarks.to_pandas().join(pd.DataFrame(bits, columns=[f"d{k}" for k in range(32)]))
        paths.append(path.with_suffix(".csv"))
        table.to_csv(paths[-1], index=False)
    reply = command(capsys, "align", *paths, *ONE, "--descriptor-metric", "hamming", "--json")
    assert reply.complaints == []
    wrong = command(capsys, "align", *paths, *ONE, "--descriptor-metric", "haming")
    assert_refused(wrong, "descriptor_metric: is 'haming'", "did you mean hamming?")


def test_align_and_merge_state_the_same_about_exact_labelled_maps(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    p = rng.uniform(0, 20, (30, 3)) * [1, 1, 0]
    paths = [tmp_path / f"{name}.parquet" for name in "ab"]
    for path, position in zip(paths, (p, p - [2, 1, 0]), strict=True):
        own = landmark_map(position, path.stem, 0.02, planar=True)
        write_map(path, replace(own, label=np.arange(30, dtype=np.int32)))
    settings = default_settings([], 0)
    merged = merge(paths, settings)
    stated = merged.fusion.fused[0].motion_covariance[1]
    assert merged.is_lower_bound(merged.fusion.fused[0])
    for row in map(alignment_row, align(paths[0], paths[1], settings)):
        assert row["lower_bound"]
        refined = [row[name] for name in COVARIANCE]
        np.testing.assert_allclose(refined, stated[np.triu_indices(3)], rtol=0.02, atol=1e-12)
