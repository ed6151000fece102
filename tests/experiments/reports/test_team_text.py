"""What screens and reports say of teams, in words."""

import math

import pandas as pd

from experiments.evaluation import tables
from experiments.reports.team_text import edge_lines, team_lines
from tests.helpers.made_up_runs import complete


def motions(**left_out: str) -> pd.DataFrame:
    """Robots with the reason why they are left out, empty for those that are placed."""
    rows = [
        {"robot": name, "left_out": why, "tx_m": math.nan if why else 0.0}
        for name, why in left_out.items()
    ]
    return complete(
        "fused_motions", pd.DataFrame(rows, columns=pd.Index(["robot", "left_out", "tx_m"]))
    )


def pairs(*rows: tuple[str, str, str, int, float]) -> pd.DataFrame:
    names = ["robot_a", "robot_b", "place", "n_common", "refined_translation_error_m"]
    frame = pd.DataFrame(rows, columns=pd.Index(names))
    return complete("team_pairs", frame.assign(refined_rotation_error_rad=0.0))


NONE = {name: tables.as_table(name, []) for name in ("team", "team_pairs")}


def test_a_team_of_which_one_is_left_out() -> None:
    team = pd.DataFrame({"source": ["final", "odometry"], "rmse": [0.0234, 9.0]})
    team = complete("team", team.assign(component=1, n_robots=2, n_team=3))
    told = team_lines(
        motions(A="", B="", C="chance would do"),
        team,
        pairs(
            ("A", "B", "bridge", 40, 0.1),
            ("A", "C", "refused", 40, math.nan),
            ("B", "C", "confirmed", 0, 0.1),
        ),
    )
    assert list(told) == [
        "2 of 3 robots are merged: their paths err by 0.023 m (ATE, one rigid fit for all)",
        "C is left out of the fused map: chance would do",
        "alignments believed: 2, right: 1; pairs with common ground: 2, found: 1",
    ]


def test_nothing_merged() -> None:
    told = team_lines(motions(A="", B="refused"), *NONE.values())
    assert list(told) == [
        "no two maps were merged, the fused map is that of A",
        "B is left out of the fused map: refused",
    ]


def test_one_robot_is_no_team() -> None:
    team = complete("team", pd.DataFrame([{"source": "final", "n_team": 1, "rmse": 0.1}]))
    assert list(team_lines(motions(), team, NONE["team_pairs"])) == []


def test_alignments_are_told_by_what_became_of_them() -> None:
    edges = pairs(
        ("A", "B", "confirmed", 0, 0.0),
        ("A", "C", "refused", 0, 0.0),
        ("B", "C", "confirmed", 0, 0.0),
        ("B", "D", "bridge", 0, 0.0),
    )
    told = ["alignments bridge: B-D", "alignments confirmed: A-B and B-C"]
    assert list(edge_lines(edges)) == told
    assert list(edge_lines(edges.head(1))) == []  # of two robots nobody else says anything
