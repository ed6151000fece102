"""Sentences about a team, for screens and reports."""

from collections.abc import Iterator

import pandas as pd

from experiments.evaluation.criteria import has_common_ground, merged_robots, right_refined
from experiments.evaluation.path_errors import is_used_by_team
from experiments.reports.formatting import listed, two_digits
from mapfusion.fusion.team_graph import EdgeStatus


def team_lines(motions: pd.DataFrame, team: pd.DataFrame, pairs: pd.DataFrame) -> Iterator[str]:
    """Describe a team by the tables `fused_motions`, `team` and `team_pairs` of one run.

    A single robot gives no lines. Without truth the last two tables have no rows, and their lines
    are left out.
    """
    final = team[team["source"] == "final"]
    for row in final[final["n_team"] > 1].to_dict("records"):
        which = "are merged" if row["component"] == 1 else "make a map of their own"
        off = f"their paths err by {two_digits(row['rmse'])} m (ATE, one rigid fit for all)"
        yield f"{row['n_robots']} of {row['n_team']} robots {which}: {off}"
    if len(motions) and not merged_robots(motions["tx_m"]):
        alone = motions.loc[motions["tx_m"].notna(), "robot"].tolist()
        yield f"no two maps were merged, the fused map is that of {listed(alone)}"
    for robot, why in motions[["robot", "left_out"]].itertuples(index=False):
        if why:
            yield f"{robot} is left out of the fused map: {why}"
    if len(pairs):
        met, used, right = has_common_ground(pairs), is_used_by_team(pairs), right_refined(pairs)
        found = (used & met & right).sum()
        yield (
            f"alignments believed: {used.sum()}, right: {found}; "
            f"pairs with common ground: {met.sum()}, found: {found}"
        )


def edge_lines(edges: pd.DataFrame) -> Iterator[str]:
    """Describe by `team_edges` how alignments agree; a single alignment gives no lines."""
    if len(edges) > 1:
        used = edges[edges["place"] != EdgeStatus.REFUSED]
        for place, rows in used.groupby("place", sort=True):
            names = (rows["robot_a"] + "-" + rows["robot_b"]).tolist()
            yield f"alignments {place}: {listed(names)}"
