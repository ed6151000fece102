"""Results of the study `team`: motions between the robots of a pose graph, and their status."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.reports.layout import Column, plain, print_frame, print_lines
from mapfusion.errors import InputError
from mapfusion.exchange import PlanarPoseGraph, read_pose_graph
from mapfusion.files import named_columns
from mapfusion.fusion.team_graph import EdgeStatus
from mapfusion.fusion.team_pose_graph import JudgedPoseGraph

_COLUMNS: dict[str, Column] = {
    "robot_a": ("robot a", ""),
    "robot_b": ("robot b", ""),
    "n": ("motions", "d"),
    "n_kept": ("kept", "d"),
    "n_contradicted": ("contradicted", "d"),
    "n_ambiguous": ("ambiguous", "d"),
    "nees": ("largest NEES\nof the kept", ".1f"),
}


def read_graph_files(paths: Sequence[Path]) -> PlanarPoseGraph:
    """Read the pose graph of files and of the robots' files in folders.

    The files of a folder are those named by a number, as 0.g2o, or else all that end in .g2o.

    Raises:
        InputError: a folder has no such files, or a file is not readable.
    """
    files = list[Path]()
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        inside = sorted(path.glob("*.g2o"))
        inside = [file for file in inside if file.stem.isdigit()] or inside
        if not inside:
            raise InputError(f"{path}: holds no .g2o files")
        files += inside
    return read_pose_graph(files)


def motions_frame(judged: JudgedPoseGraph) -> pd.DataFrame:
    """Return one row for each motion between robots."""
    robots = judged.edges.robots
    columns: dict[str, Any] = {
        "robot_a": [judged.robots[k] for k in robots[:, 0]],
        "robot_b": [judged.robots[k] for k in robots[:, 1]],
        "key_a": judged.keys[:, 0],
        "key_b": judged.keys[:, 1],
        "status": [str(status) for status in judged.status],
        "kept": judged.is_kept,
    }
    columns |= named_columns(("tx_m", "ty_m", "theta_rad"), judged.edges.T_a_b)
    return pd.DataFrame(columns | {"nees": judged.squared_distance})


def team_document(judged: JudgedPoseGraph) -> dict[str, Any]:
    """Return the JSON document: robots with their poses, noise, and all motions between robots."""
    names = ("tx_m", "ty_m", "theta_rad")
    robots = pd.DataFrame({"robot": judged.robots, "n_poses": judged.n_poses})
    robots = robots.assign(frame_of=_frame_of(judged), **named_columns(names, judged.T_root_robot))
    noise = None if judged.noise is None else judged.noise._asdict()
    return {
        "robots": robots,
        "noise_factors": noise,
        "nees_per_dof": judged.nees_per_dof,
        "n_left_out": judged.n_left_out,
        "motions": motions_frame(judged),
    }


def _frame_of(judged: JudgedPoseGraph) -> list[str]:
    """Return the robot whose frame is that of each robot's component."""
    component = judged.component.tolist()
    return [judged.robots[component.index(name)] for name in component]


def print_team(judged: JudgedPoseGraph) -> None:
    """Print the motions between any two robots, and what they say of the team."""
    rows = motions_frame(judged)
    statuses = {"n_contradicted": EdgeStatus.CONTRADICTED, "n_ambiguous": EdgeStatus.AMBIGUOUS}
    counts = {name: rows["status"] == str(status) for name, status in statuses.items()}
    rows = rows.assign(n=1, n_kept=rows["kept"], **counts, nees=rows["nees"].where(rows["kept"]))
    sums = dict.fromkeys(("n", "n_kept", *counts), "sum") | {"nees": "max"}
    print_frame(rows.groupby(["robot_a", "robot_b"], as_index=False).agg(sums), _COLUMNS)
    n_kept, largest = int(judged.is_kept.sum()), (judged.component == 0).sum()
    lines = [
        f"{len(judged.robots)} robots with {judged.n_poses.sum()} poses; {n_kept} of {len(rows)} "
        f"motions between robots kept; {largest} robots in one frame",
        f"NEES per degree of freedom of the kept: {judged.nees_per_dof:.2f} (1 is expected "
        "of independent errors)",
    ]
    if judged.noise is None:
        lines.append("noise as stated: not checked, the robots' own paths have too few loops")
    else:
        along, turning = judged.noise
        lines.append(
            f"noise: {along:.3g} times the stated sigma of translations, {turning:.3g} times that "
            "of rotations"
        )
    if judged.n_left_out:
        lines.append(
            f"{judged.n_left_out} motions are left out: no file has their poses, or a robot's own "
            "motions do not connect them"
        )
    print_lines([plain(line) for line in lines])
