"""`--json` prints one document only; refused values are null with a reason."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapfusion.fusion.map_merging import sigma_number
from mapfusion.geometry import se2
from mapfusion.landmark_map import write_map
from tests.helpers.made_up_maps import landmark_map
from tests.helpers.made_up_runs import write_sweep
from tests.helpers.tiny_scenario import Reply, command

T_A_B = np.array([1.0, -2.0, 0.3])


def document(reply: Reply, kind: str) -> dict[str, Any]:
    """The one document on standard output, without what JSON has no name for."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    found = json.loads(reply.out, parse_constant=refuse)
    assert (found["schema_version"], found["kind"]) == (1, kind)
    return found


@pytest.fixture
def maps(tmp_path: Path) -> list[Path]:
    """Maps A and B of twenty labelled points, C of twenty others; their names mean to be markup."""
    rng = np.random.default_rng(0)
    p = rng.uniform(0, 10, (20, 3))
    moved = se2.transform_points(se2.inverse(T_A_B), p)
    other = rng.uniform(0, 10, (20, 3))
    paths = []
    for name, position in (("A", p), ("B", moved), ("C", other)):
        landmarks = landmark_map(position, f"{name}[/b]")
        object.__setattr__(landmarks, "label", np.arange(20, dtype=np.int32))
        paths.append(tmp_path / f"{name}[/b].parquet")
        write_map(paths[-1], landmarks)
    return paths


ONE = ("--set", "align.aligners=[{name: svd, method: svd}]", "--set", "merge.aligner=svd")


def test_align(maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reply = command(capsys, "align", *maps[:2], *ONE, "--json", "-o", tmp_path / "deep/a.json")
    assert (reply.code, reply.err) == (0, "")
    found = document(reply, "align")
    assert (tmp_path / "deep/a.json").read_text() == reply.out
    assert found["map_a"] == str(maps[0])
    (row,) = found["aligners"]
    assert (row["aligner"], row["status"]) == ("svd", "accepted")
    assert "are the same map" in row["reason"]  # the positions are equal
    for each in (row["estimated"], row["refined"]):
        motion = [each["tx_m"], each["ty_m"], each["theta_rad"]]
        np.testing.assert_allclose(motion, T_A_B, atol=1e-9)
    assert row["n_inliers"] == row["n_correspondences"] == 20
    assert row["refined"]["cov_xx_m2"] > 0
    assert row["elapsed_s"] > 0


def test_what_is_refused_is_null_with_a_reason(
    maps: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    found = document(command(capsys, "align", *maps[::2], *ONE, "--json"), "align")
    (row,) = found["aligners"]
    assert row["status"] == "refused"
    assert row["refined"] is None
    assert row["reason"]
    assert row["reason"].partition(";")[0] in found["advice"]
    told = command(capsys, "align", *maps[::2], *ONE).out
    assert told.count(row["reason"].partition(";")[0]) == 1
    assert told.count("20 labels are in both maps") == 1
    assert told.splitlines()[-1] == found["advice"]


def test_merge(maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fused = tmp_path / "mk[/b]" / "f.parquet"
    arguments = ("merge", *maps[:1], maps[2], maps[1], *ONE, "-o", fused)
    found = document(command(capsys, *arguments, "--json"), "merge")
    assert fused.is_file()
    assert found["map"] == str(fused)
    first, apart, second = found["maps"]
    assert first == {
        "map": str(maps[0]),
        "T_first_map": {"tx_m": 0.0, "ty_m": 0.0, "theta_rad": 0.0},
        "covariance": dict.fromkeys(second["covariance"], 0.0),
        "covariance_at_middle": dict.fromkeys(second["covariance"], 0.0),
        "height_m": 0.0,
        "reason": None,
    }
    assert apart["T_first_map"] is apart["covariance"] is None
    assert apart["reason"]
    np.testing.assert_allclose([*second["T_first_map"].values()], T_A_B, atol=1e-9)
    stated = second["covariance_at_middle"]
    assert min(stated["cov_xx_m2"], stated["cov_yy_m2"], stated["cov_tt_rad2"]) > 0
    assert found["n_fused_of_several"] == found["n_landmarks"] == 20
    shown = command(capsys, *arguments)
    assert shown.code == 0
    assert f"20 landmarks in {fused}" in shown.out
    sigma_m = (stated["cov_xx_m2"] + stated["cov_yy_m2"]) ** 0.5
    sigma_rad = stated["cov_tt_rad2"] ** 0.5
    assert found["lower_bound"] is True  # these maps have no joint covariance
    assert f"sigma ≥ {sigma_number(sigma_m, 3)} m, ≥ {sigma_number(sigma_rad, 4)} rad" in shown.out


def test_slam(tiny_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    few = ("--set", "slam.filter.n_particles=2", "--json")
    reply = command(capsys, "slam", tiny_log, "-o", tmp_path / "m.parquet", *few)
    found = document(reply, "slam")
    assert (found["robot"], found["seed"]) == ("R1", 0)
    assert found["map"] == str(tmp_path / "m.parquet")
    assert found["n_landmarks"] > 0


def test_check(
    tiny_path: Path, tiny_results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--jobs", 1, "--results", tiny_results, "--seeds", 3)
    reply = command(capsys, "check", tiny_path, *where, "--json", "-o", tmp_path / "c.json")
    assert reply.code == 0
    found = document(reply, "check")
    assert (tmp_path / "c.json").read_text() == reply.out
    (scenario,) = found["scenarios"]
    assert found["passed"] is scenario["passed"] is True
    assert scenario["elapsed_s_by_seed"]["3"] > 0
    (outcome,) = scenario["outcomes"]
    assert (outcome["metric"], outcome["min"], outcome["max"]) == ("path_rmse_m", None, 1)
    assert 0 < outcome["value"] == outcome["by_seed"]["3"] < 1


def test_statistics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sweep = write_sweep(tmp_path / "sweep", range(3))
    found = document(command(capsys, "statistics", sweep, "--json"), "statistics")
    assert (found["n_runs"], found["written"]) == (3, None)
    unknown = [
        "path_statistics",
        "team",
        "team_pairs",
        "landmark_nees",
        "smoother",
        "fusers",
        "fusion",
        "smoothed_errors",
    ]
    assert found["missing_tables"] == unknown
    rows = found["tables"]["error_over_oracle"]
    assert {"ransac", "oracle"} <= {row["aligner"] for row in rows}
    assert all(row["estimated_m"] is None or math.isfinite(row["estimated_m"]) for row in rows)
