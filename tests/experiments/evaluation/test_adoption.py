"""Tests of `experiments.evaluation.adoption` and of the stage `team`."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation import tables
from experiments.evaluation.adoption import (
    TeamMember,
    event_rows,
    false_adoptions,
    member_rows,
)
from experiments.pipeline.stages import slam, team
from experiments.pipeline.stages.pipeline import build_pipeline
from experiments.pipeline.tables import COVARIANCE, write_rows
from experiments.scenario.loading import load_scenario
from mapfusion.errors import InputError
from mapfusion.files import COVARIANCE_FIELDS, POSE_FIELDS
from mapfusion.robot_log import RobotTruth
from tests.helpers.tiny_scenario import TRIO

N_FRAMES = 5


def straight(off_m: float) -> np.ndarray:
    """Poses along x, with an error along y in the last two frames."""
    path = np.zeros((N_FRAMES, 3))
    path[:, 0] = np.arange(N_FRAMES)
    path[-2:, 1] = off_m
    return path


def rows_of(path: np.ndarray, **same: object) -> pd.DataFrame:
    return pd.DataFrame(path, columns=pd.Index(POSE_FIELDS)).assign(
        iteration=np.arange(len(path)), **same
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Tables of a team of A and B. A adopts the map of B in frame 2, B adopts nothing."""
    made, last = tmp_path / "team", N_FRAMES - 1
    made.mkdir()
    paths = [rows_of(straight(0.3), robot="A", evaluated=last)]
    paths += [rows_of(straight(0.0), robot="B", evaluated=last)]
    # twice the point (9, 1) of the world, then an own landmark
    points = [("B", 9.1, 1.0, 0), ("B", 8.9, 1.2, 0), ("A", 0.0, 3.0, 7)]
    maps = pd.DataFrame(points, columns=pd.Index(["origin", "x_m", "y_m", "row"]))
    maps = maps.assign(**dict.fromkeys(COVARIANCE_FIELDS, 0.0), z_m=0.0, count=3, robot="A")
    maps = maps.assign(cov_xx_m2=0.01, cov_yy_m2=0.01, cov_zz_m2=0.01, iteration=last)
    steps = [
        {"robot": name, "iteration": k, "n_observed": 10, "n_shared": k * (name == "A")}
        | dict.fromkeys(POSE_FIELDS, 0.0)
        for name in "AB"
        for k in range(N_FRAMES)
    ]
    event = {"robot": "A", "other": "B", "tx_m": 10.3, "ty_m": 0.4, "theta_rad": np.pi / 2 - 0.01}
    event |= dict.fromkeys(COVARIANCE, 0.0) | {"reason": ""}
    events = [event | {"iteration": 1, "event": "on trial"}]
    events += [event | {"iteration": 2, "event": "adopted"}]
    message = {"sender": "A", "receiver": "B", "n_landmarks": 1, "n_new": 1, "lost": False}
    messages = [message | {"iteration": k, "n_bytes": 500, "arrives_s": 1.0} for k in (2, 4)]
    given = {"steps": steps, "events": events, "messages": messages}
    given |= {"paths": pd.concat(paths), "maps": maps}
    schemas = {"steps": team.STEPS, "events": team.EVENTS, "messages": team.MESSAGES}
    schemas |= {"paths": team.PATHS, "maps": team.MAPS}
    for name, rows in given.items():
        write_rows(made / f"{name}.parquet", schemas[name], rows)
    for name in "AB":
        (tmp_path / name).mkdir()
        alone = rows_of(straight(0.6), evaluated=last)
        write_rows(tmp_path / name / "paths.parquet", slam.PATHS, alone)
    return made


def members(folder: Path) -> list[TeamMember]:
    path = straight(0.0)
    in_world = np.stack([10 - path[:, 1], path[:, 0], path[:, 2] + np.pi / 2], axis=1)
    truths = {"A": path, "B": in_world}
    points = {"A": np.full((9, 3), np.nan), "B": np.array([[9.0, 1.0, 0.0]])}
    smoothed = {N_FRAMES - 1: straight(0.1)}
    return [
        TeamMember(name, RobotTruth(truths[name], points[name]), folder.parent / name, smoothed)
        for name in "AB"
    ]


def test_paths_are_compared_from_the_first_adoption_on(folder: Path) -> None:
    a, b = member_rows(folder, members(folder))
    assert a["path_rmse_m"] == pytest.approx(0.3 * np.sqrt(2 / 5))
    assert a["alone_path_rmse_m"] == pytest.approx(0.6 * np.sqrt(2 / 5))
    assert a["smoothed_path_rmse_m"] == pytest.approx(0.1 * np.sqrt(2 / 5))
    assert a["merged_path_rmse_m"] == pytest.approx(0.3)  # frames 3 and 4
    assert a["alone_merged_path_rmse_m"] == pytest.approx(0.6)
    assert np.isnan(b["merged_path_rmse_m"])
    assert b["path_rmse_m"] == pytest.approx(0, abs=1e-12)
    assert a["shared_share"] == pytest.approx((3 + 4) / 20)
    assert (a["sent_kb"], b["sent_kb"]) == (1.0, 0.0)


def test_landmarks_of_other_robots_are_judged_in_the_frame_of_the_map(folder: Path) -> None:
    a, b = member_rows(folder, members(folder))
    assert (a["n_landmarks"], a["n_adopted"]) == (3, 2)
    # errors of 0.1 m and of sqrt(0.05) m, which is gross
    assert a["gross_share"] == 0.5
    assert a["landmark_rmse_m"] == np.inf  # too many are gross
    assert a["frame_coverage_95"] == 1.0  # squares of 1 and 5, the bound is 5.99
    assert (b["n_adopted"], b["n_landmarks"]) == (0, 0)
    assert np.isnan(b["landmark_rmse_m"])


def test_motions_are_compared_with_the_true_starts(folder: Path) -> None:
    rows = event_rows(folder, members(folder))
    assert rows["translation_error_m"].tolist() == pytest.approx([0.5, 0.5])
    assert rows["rotation_error_rad"].tolist() == pytest.approx([-0.01, -0.01])
    assert false_adoptions(rows.assign(translation_error_m=0.4)) == 0
    wrong = rows.assign(translation_error_m=9.0)
    assert false_adoptions(wrong) == 1
    dropped = wrong.iloc[-1:].assign(event="dropped", iteration=4)
    assert false_adoptions(pd.concat([wrong, dropped])) == 0


def test_a_run_judges_its_team_beside_the_independent_robots(trio_result: Path) -> None:
    rows = tables.read(tables.table_path(trio_result, "team_members"), "team_members")
    paths = tables.read(tables.table_path(trio_result, "paths"), "paths")
    assert rows["robot"].unique().tolist() == ["R1", "R2", "R3"]
    for robot, own in rows.groupby("robot"):
        last = own.loc[own["iteration"].idxmax()]
        path = paths[paths["robot"] == robot]
        off = [path[f"final_{axis}"] - path[f"truth_{axis}"] for axis in ("x_m", "y_m")]
        rmse_m = np.sqrt(np.mean(np.square(off).sum(axis=0)))
        assert last["alone_path_rmse_m"] == pytest.approx(rmse_m, rel=1e-9)
        before = own[own["n_adopted"] == 0].iloc[0]
        assert before["path_rmse_m"] == pytest.approx(before["alone_path_rmse_m"], rel=1e-12)
    sent = tables.read(tables.table_path(trio_result, "messages"), "messages")
    assert (sent["iteration"] % 8 == 0).all()
    assert sent["n_bytes"].min() > 100


@pytest.mark.parametrize(
    ("team", "told"),
    [
        ("{link: {loss: 1.5}}", "team.link.loss: is 1.5"),
        ("{link: {every: 4}}", "team.link.every: is 4"),
        ("{starts: {R2: 5}, carried: {R2: R1}}", "R2 starts when the log of R1 ends"),
        ("{carried: {R2: R1, R1: R2}}", "a robot comes before itself"),
    ],
)
def test_settings_that_cannot_be_are_refused(tmp_path: Path, team: str, told: str) -> None:
    path = tmp_path / "trio.yaml"
    path.write_text(TRIO.replace("team: {link: {every: 8}}", f"team: {team}"))
    with pytest.raises(InputError, match=r"trio\.yaml") as refused:
        load_scenario(path)
    assert told in str(refused.value)


def test_unknown_robots_are_named(tmp_path: Path) -> None:
    path = tmp_path / "trio.yaml"
    path.write_text(TRIO.replace("team: {link: {every: 8}}", "team: {carried: {R9: R1}}"))
    with pytest.raises(InputError, match=r"team.carried: there is no robot R9, known are R1, R2"):
        build_pipeline(load_scenario(path))
