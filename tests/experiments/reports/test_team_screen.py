"""Tests of `mapfusion study team`."""

import json
from pathlib import Path

import pandas as pd
import pytest

from experiments.evaluation.alignment_criteria import is_used_by_team
from experiments.reports.figures.result_tables import ResultTables
from tests.helpers.tiny_scenario import assert_refused, command
from tests.mapfusion.fusion.test_team_pose_graph import SIDE, write_grid


def test_an_exported_graph_is_judged_as_the_run_did(
    trio_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command(capsys, "export", trio_result, "--format", "g2o", "-o", tmp_path)
    reply = command(capsys, "study", "team", tmp_path / "team.g2o", "--json")
    assert reply.code == 0, reply.err
    found = json.loads(reply.out)
    edges = ResultTables(trio_result).rows("team_edges")
    used = edges[is_used_by_team(edges)]
    assert {(row["robot_a"], row["robot_b"]) for row in found["motions"] if row["kept"]} == set(
        used[["robot_a", "robot_b"]].itertuples(index=False, name=None)
    )
    assert found["noise_factors"] is None
    assert [row["robot"] for row in found["robots"]] == ["R1", "R2", "R3"]


def test_a_folder_of_robots_is_one_graph(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "graphs"
    folder.mkdir()
    robots = write_grid(folder, 2, seed=1, wrong=1)
    (folder / "fullGraph.g2o").write_text("the graph with other keys")
    reply = command(capsys, "study", "team", folder, "-o", tmp_path / "motions.csv")
    assert reply.code == 0, reply.err
    rows = pd.read_csv(tmp_path / "motions.csv")
    assert set(rows["robot_a"]) | set(rows["robot_b"]) == set(robots)
    assert len(rows) == 4 * SIDE * 2
    assert rows["status"].value_counts()["contradicted"] == 1
    assert f"{len(rows) - 1} of {len(rows)} motions between robots kept" in reply.out
    assert "4 robots in one frame" in reply.out


def test_a_team_that_nothing_connects_is_code_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "two.g2o"
    path.write_text("# R1,\nVERTEX_SE2 0 0 0 0\n# R2,\nVERTEX_SE2 1 0 0 0\n")
    reply = command(capsys, "study", "team", path)
    assert reply.code == 1
    assert "no two robots are connected" in reply.err


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert_refused(command(capsys, "study", "team", tmp_path), str(tmp_path), "holds no .g2o files")
    assert_refused(command(capsys, "study", "team", tmp_path / "none.g2o"), "no such file")
    write_grid(tmp_path, 2, seed=0)
    assert_refused(command(capsys, "study", "team", tmp_path / "0.g2o"), "two robots or more")
    assert_refused(
        command(capsys, "study", "team", tmp_path, "-o", tmp_path / "m.txt"), "expected .csv"
    )
