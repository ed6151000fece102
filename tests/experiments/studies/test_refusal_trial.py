"""Maps crossed between worlds: the cases, the rates, the tables and the command."""

import itertools
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation.result import run_scenario
from experiments.pipeline.tables import read_rows
from experiments.reports.figures.drawing import save_figure
from experiments.reports.figures.study_figures import draw_refusal
from experiments.reports.study_files import KINDS
from experiments.scenario.settings import Simulation
from experiments.scenario.world_settings import Render
from experiments.studies import refusal_trial as results
from experiments.studies.refusal_rates import Rate, share_up_to, summary
from experiments.studies.refusal_trial import STATED, accepted_motions, calibrate, points_on_walls
from mapfusion.align.correspondences import MatchParameters
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.descriptors import USURF
from mapfusion.geometry import se2
from mapfusion.verification.false_alarms import Acceptance, fewest_false_alarms, independent_pairs
from tests.helpers.made_up_maps import ITERATION, robot
from tests.helpers.tiny_scenario import command

MATCHING = MatchParameters(max_descriptor_distance=0.3)


def described(name: str, points: np.ndarray, T_world_map: list[float], seed: int):
    """Return a robot with one map whose descriptors depend on the seed."""
    made = robot(name, points, np.array(T_world_map))
    vectors = np.random.default_rng(seed).standard_normal((len(points), USURF.length))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    made.maps[ITERATION] = replace(
        made.maps[ITERATION], descriptor=vectors.astype(np.float32), name=name
    )
    return made


@pytest.fixture
def same_world() -> results.Case:
    points = np.random.default_rng(0).uniform(0, 8, (60, 3)) * [1, 1, 0.3]
    a = described("A", points, [1.0, 2.0, 0.3], 1)
    b = described("B", points, [-1.0, 0.5, 2.0], 1)
    return results.common(a, b, ITERATION, MATCHING, 0.1)


def test_maps_of_one_world(same_world: results.Case) -> None:
    assert (same_world.ground, same_world.n_common, same_world.is_true.sum()) == ("common", 60, 60)
    expected = se2.between(np.array([1.0, 2.0, 0.3]), np.array([-1.0, 0.5, 2.0]))
    assert same_world.T_true == pytest.approx(expected)


def test_few_leaves_twenty_neighbours(same_world: results.Case) -> None:
    fewer = results.few(same_world, np.random.default_rng(1))
    assert fewer is not None
    assert (fewer.ground, fewer.is_true.sum(), len(fewer.pairs)) == ("few", 20, 20)
    kept = same_world.map_a.position_m[fewer.pairs.index_a]
    everyone = same_world.map_a.position_m
    # a ball about one of them holds these and no others
    reach = np.linalg.norm(kept[:, None] - kept[None], axis=2).max(axis=1)
    inside = np.linalg.norm(everyone[None] - kept[:, None], axis=2) <= reach[:, None] + 1e-9
    assert inside.sum(axis=1).min() == 20
    assert results.few(fewer, np.random.default_rng(1)) is None


def test_a_poster_hangs_elsewhere_and_looks_the_same(same_world: results.Case) -> None:
    other = described("C", np.random.default_rng(5).uniform(0, 8, (40, 3)), [0, 0, 0], 7)
    landmarks = other.maps[ITERATION]
    case = results.repeated(same_world, landmarks, 4.0, MATCHING, np.random.default_rng(2))
    assert case is not None
    assert (case.ground, case.poster_radius_m, case.n_common) == ("repeated", 4.0, 0)
    hung = case.map_b[np.arange(len(landmarks), len(case.map_b))]
    assert len(hung) > 3
    assert not case.is_true.any()
    # what hangs there is a rigid copy of a part of b, with its looks
    b = same_world.map_b
    found = [int(np.argmin(np.linalg.norm(b.descriptor - d, axis=1))) for d in hung.descriptor]
    apart = np.linalg.norm(hung.position_m[:, None] - hung.position_m[None], axis=2)
    original = np.linalg.norm(b.position_m[found][:, None] - b.position_m[found][None], axis=2)
    np.testing.assert_allclose(apart, original, atol=1e-9)
    np.testing.assert_allclose(hung.position_m[:, 2], b.position_m[found, 2])


def rows_of(*entries: tuple) -> pd.DataFrame:
    """Rows of `refusals` from (ground, n_common, n_true, accepted, error, log10)."""
    names = ["ground", "n_common", "n_true", "accepted", "refined_translation_error_m"]
    frame = pd.DataFrame(list(entries), columns=pd.Index([*names, "log10_false_alarms"]))
    ground = frame["ground"]
    frame["aligner"] = "ransac"
    frame["kind"], frame["repeats"] = "tiny", False
    frame["world_a"], frame["world_b"] = "tiny-1", np.where(ground == "apart", "tiny-2", "tiny-1")
    frame["robot_a"], frame["robot_b"], frame["iteration"] = "R1", "R2", np.arange(len(frame))
    frame["status"] = np.where(frame["accepted"], "accepted", "refused")
    frame["beats_chance"] = frame["accepted"]
    frame["refined_rotation_error_rad"] = 0.0
    frame["poster_radius_m"] = np.where(frame["ground"] == "repeated", 1.0, np.nan)
    frame["n_inliers"] = 10
    return frame


TABLE = rows_of(
    ("apart", 0, 0, False, math.nan, 2.0),
    ("apart", 0, 0, True, math.nan, -4.0),
    ("common", 0, 0, False, 9.0, 1.0),
    ("common", 90, 30, True, 0.1, -30.0),
    ("common", 90, 30, False, 0.1, -2.0),
    ("common", 90, 30, False, 5.0, math.nan),
    ("common", 9, 5, True, 5.0, -5.0),
    ("few", 90, 20, True, 0.7, -9.0),
    ("few", 90, 20, False, 0.2, -1.0),
    ("repeated", 0, 0, True, math.nan, -7.0),
)


def test_rates_worked_out_by_hand() -> None:
    repeating = TABLE.assign(repeats=True, accepted=~TABLE["accepted"])  # left out
    (row,) = summary(pd.concat([TABLE, repeating]))
    assert row["false"] == Rate(1, 3)
    assert row["wrong"] == Rate(1, 4)
    assert row["missed"] == Rate(2, 3)
    assert row["missed_though_right"] == Rate(1, 2)
    assert row["few_missed_though_right"] == Rate(1, 1)
    assert row["few_wrong"] == Rate(1, 2)
    assert (row["poster_0.5"], row["poster_1"]) == (Rate(0, 0), Rate(1, 1))


def test_wilsons_interval() -> None:
    # Brown, Cai and DasGupta (2001), eq. 4, for 0 of n: z^2 / (n + z^2)
    z2 = 1.959964**2
    low, high = Rate(0, 500).interval
    assert (low, high) == pytest.approx((0, z2 / (500 + z2)), abs=1e-6)
    assert all(math.isnan(end) for end in Rate(0, 0).interval)


def test_sweeping_accepts_up_to_the_threshold_and_never_nan() -> None:
    score = pd.Series([-5.0, -3.0, 1.0, math.nan])
    np.testing.assert_allclose(
        share_up_to(score, np.array([-6, -5, -3.5, 99])), [0, 0.25, 0.25, 0.75]
    )


def test_calibration_counts_every_motion_of_two_pairs() -> None:
    rng = np.random.default_rng(3)
    n = 30
    p_a, p_b = points_on_walls(rng, n), points_on_walls(rng, n)
    gates, bounds = np.array([0.1, 0.4]), np.array([1.0, 2.0, 2.5, 4.0])
    pairs = independent_pairs(p_a, p_b, np.zeros((n, 4)))
    expected = np.zeros(4, np.int64)
    for i, j in itertools.combinations(range(n), 2):
        T_a_b = np.array(fit_rigid(p_a, p_b, np.array([i, j])))
        log10 = fewest_false_alarms(pairs, T_a_b, gates)[0]
        expected += log10 <= bounds
    assert expected[-1] > expected[0]
    np.testing.assert_array_equal(accepted_motions(pairs, gates, bounds), expected)


def test_stated_number_of_false_alarms_bounds_the_measured_one() -> None:
    """Every motion of 150 pairs of random maps: its mean number stays below the stated one."""
    rows = calibrate(Acceptance(), np.random.default_rng(4), n_pairs=150)
    assert rows["stated"].tolist() == list(STATED)
    assert (rows["motions_a_pair"] <= rows["stated"]).all()
    assert rows["n_accepted"].iloc[-1] > 0  # a hundred false alarms stated: some are there


@pytest.fixture
def few_pairs(monkeypatch: pytest.MonkeyPatch) -> int:
    """Calibrate with few pairs of maps; thousands take long and test no more."""
    monkeypatch.setattr(results, "N_PAIRS_OF_MAPS", 50)
    return 50


@pytest.fixture(scope="module")
def other_result(tiny: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the result of the tiny scenario with another seed's textures and one aligner."""
    folder = tmp_path_factory.mktemp("other")
    alone = {"aligners": tiny.align.aligners[:1], "repetitions": 1}
    align = tiny.align.model_copy(update=alone)
    other = tiny.model_copy(update={"seed": 4, "align": align})
    return run_scenario(other, folder, 1, lambda stage, done, total: None)


def test_the_command_crosses_two_worlds(
    tiny_result: Path,
    other_result: Path,
    few_pairs: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    both = [tiny_result, other_result]
    reply = command(
        capsys, "study", "refusal", *both, "-o", tmp_path / "one", "--pairs", 6, "--jobs", 1
    )
    assert reply.code == 0, reply.err
    assert "false" in reply.out
    rows = results.read(tmp_path / "one", "refusals")
    apart, common = rows[rows["ground"] == "apart"], rows[rows["ground"] == "common"]
    assert len(apart) == 6 * 3  # three aligners
    assert len(common) == 2 * 5 * 3  # two worlds, five iterations
    assert (apart["world_a"] != apart["world_b"]).all()
    assert apart["refined_translation_error_m"].isna().all()
    assert not apart["accepted"].any()
    assert (common["world_a"] == common["world_b"]).all()
    assert (results.read(tmp_path / "one", "calibration")["n_pairs"] == few_pairs).all()
    assert (tmp_path / "one" / "figures" / "refusal.png").stat().st_size > 10_000

    again = command(
        capsys, "study", "refusal", *both, "-o", tmp_path / "two", "--pairs", 6, "--jobs", 2
    )
    assert again.code == 0, again.err
    for name in results.TABLES:
        pd.testing.assert_frame_equal(
            results.read(tmp_path / "one", name), results.read(tmp_path / "two", name)
        )


@pytest.mark.usefixtures("few_pairs")
def test_worlds_may_be_scenarios_with_seeds(
    tiny: Simulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Write maps to a store without a result folder, as a sweep does."""
    short = tiny.model_copy(
        update={
            "drive": tiny.drive.model_copy(update={"frames": 16}),
            "render": Render(renderer="raycast"),
            "align": tiny.align.model_copy(update={"aligners": tiny.align.aligners[:2]}),
        }
    )
    texture = replace(tiny.world.texture, posters=2)
    hung = tiny.world.model_copy(update={"texture": texture})
    worlds = [short, short.model_copy(update={"world": hung})]
    paths = []
    for name, world in zip(("plain", "hung"), worlds, strict=True):
        paths.append(tmp_path / f"{name}.yaml")
        paths[-1].write_text(world.model_copy(update={"name": name}).model_dump_json())
    common = ("--seeds", "5,6", "--results", tmp_path, "--jobs", 1)
    missing = command(capsys, "study", "refusal", *paths, "-o", tmp_path / "out", *common)
    assert missing.complaints[0].startswith("mapfusion: plain-5: the maps of R1 are not in ")
    assert command(capsys, "sweep", *paths, "-o", tmp_path / "s", *common).code == 0
    asked = (*common[2:], "--pairs", 2)
    words = (f"{paths[0]}@5,6", paths[1], "--seeds", "5,6")
    reply = command(capsys, "study", "refusal", *words, "-o", tmp_path / "out", *asked)
    assert reply.code == 0, reply.err
    rows = results.read(tmp_path / "out", "refusals")
    common_ones = rows[rows["ground"] == "common"]
    assert common_ones["world_a"].unique().tolist() == ["hung-5", "hung-6", "plain-5", "plain-6"]
    repeats = rows["world_a"].str.startswith("hung") | rows["world_b"].str.startswith("hung")
    assert (rows["repeats"] == repeats).all()
    assert not repeats[rows["ground"].isin(["few", "repeated"])].any()
    apart = rows[rows["ground"] == "apart"].drop_duplicates(
        ["world_a", "robot_a", "robot_b", "iteration", "world_b"]
    )
    assert apart.groupby("kind").size().to_dict() == {"crossed_repeating": 2, "hung": 2, "plain": 2}
    crossed = rows[rows["world_a"] != rows["world_b"]]
    assert (crossed["world_a"].str[-1] != crossed["world_b"].str[-1]).all()
    alone = command(
        capsys, "study", "refusal", *paths, "-o", tmp_path / "x", *common[2:], "--seeds", 5
    )
    assert "all worlds have seed 5" in alone.complaints[0]
    kinds = read_rows(tmp_path / "out" / "tables" / "kinds.parquet", KINDS)
    assert kinds["kind"].unique().tolist() == ["crossed_repeating", "hung", "plain"]


def test_wrong_results_are_named(
    tiny_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folders, problem in (
        ([tiny_result], "two worlds or more"),
        ([tiny_result, tiny_result], "the same world"),
        ([tiny_result, tmp_path], "not a result folder"),
    ):
        reply = command(capsys, "study", "refusal", *folders, "-o", tmp_path / "out")
        assert reply.code == 2
        assert len(reply.complaints) == 1
        assert problem in reply.complaints[0]


def test_maps_no_longer_there_are_named(
    tiny_result: Path, other_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = tmp_path / "moved"
    alone.mkdir()
    (alone / "tables").mkdir()
    (alone / "scenario.json").write_bytes((other_result / "scenario.json").read_bytes())
    reply = command(capsys, "study", "refusal", tiny_result, alone, "-o", tmp_path / "out")
    assert reply.code == 2
    assert "run its scenario again" in reply.complaints[0]


def test_worlds_of_one_name_are_refused(
    tiny_result: Path, other_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows are told apart by their worlds' names."""
    copied = shutil.copytree(other_result.parent, tmp_path / "copy")
    renamed = (copied / other_result.name).rename(copied / tiny_result.name)
    reply = command(capsys, "study", "refusal", tiny_result, renamed, "-o", tmp_path / "out")
    assert reply.code == 2
    assert f"is named as {tiny_result} is" in reply.complaints[0]


def test_the_figure_is_the_same_bytes(tmp_path: Path) -> None:
    calibration = calibrate(Acceptance(), np.random.default_rng(0), n_pairs=20)
    data = (TABLE, calibration, 1e-3)
    first = save_figure(tmp_path / "a", "refusal", draw_refusal, *data)
    second = save_figure(tmp_path / "b", "refusal", draw_refusal, *data)
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
