"""What makes the tables of a finished run."""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge import fused_landmarks, tables
from experiments.judge.findings import finding_rows
from experiments.judge.fused_landmarks import FusedTeam
from experiments.judge.fuser_coverage import coverage_rows
from experiments.judge.judged_fusers import JudgedFusion, fuser_rows
from experiments.judge.judged_run import JudgedRun
from experiments.judge.judging import ALIGNED
from experiments.judge.map_history import fused_history_rows, map_history_rows, true_pair_rows
from experiments.judge.path_errors import path_statistics_rows, robot_paths
from experiments.judge.smoothed_robots import SmoothedRobot, smoothed_path_rows, smoother_rows
from experiments.judge.team_figures import team_pair_rows, team_rows
from experiments.run.frames import read_rows
from experiments.run.stages import slam
from mapfusion.fuse.registry import make_fuser
from mapfusion.se2 import Float
from mapfusion.storage import POSE_FIELDS, named_columns

Maker = Callable[[], Any]
_LONG = ("fused_map", "fusers", "fuser_coverage")  # to make, of those that figures read
_IN_NO_FIGURE = ("map_history", "fused_history", "path_statistics", "timings")


def all_tables(
    run: JudgedRun, team: FusedTeam, only: Collection[str] = tuple(tables.ALL)
) -> dict[str, pd.DataFrame]:
    """The tables of a finished run's last maps, paths, estimates and errors, by their names.

    Of `only` those, if it is given: a sweep of short runs spends its time on the others.
    """
    made_by = makers(run, team).items()
    return {name: tables.framed(name, make()) for name, make in made_by if name in only}


def in_order(made: Mapping[str, Maker]) -> tuple[dict[str, Maker], dict[str, Maker]]:
    """Those that figures read, what takes long last, and those that no figure reads.

    In this order they are to be written: figures are drawn meanwhile, from what is there.
    """
    of_figures = (name for name in made if name not in _IN_NO_FIGURE)
    first = {name: made[name] for name in sorted(of_figures, key=_LONG.__contains__)}
    return first, {name: made[name] for name in _IN_NO_FIGURE}


def makers(run: JudgedRun, team: FusedTeam) -> dict[str, Maker]:
    """What makes these tables, by their names."""
    settings = run.settings

    @cache
    def smoothed() -> list[SmoothedRobot]:
        return run.load_smoothed(team.robots)

    @cache
    def paths() -> pd.DataFrame:
        return _paths(run, smoothed())

    @cache
    def fusions() -> list[JudgedFusion]:
        return run.load_fusions(team.robots, smoothed())

    of_pairs = ("errors", *ALIGNED, "fusion")
    of_all: dict[str, Maker] = {name: partial(run.pair_table, name) for name in of_pairs}
    of_all |= {
        "landmarks": lambda: pd.concat(
            [fused_landmarks.landmark_rows(r, *r.at(team.iteration)) for r in team.robots],
            ignore_index=True,
        ),
        "paths": paths,
        "robots": paths,
        "clouds": lambda: _clouds(run),
        "smoothed_paths": lambda: smoothed_path_rows(smoothed()),
        "fused": lambda: fused_landmarks.fused_rows(team),
        "fused_motions": lambda: fused_landmarks.fused_motion_rows(team),
        "fused_map": lambda: _fused_map_rows(run, fusions()),
    }
    judged: dict[str, Maker] = {
        "fusers": lambda: fuser_rows(fusions()),
        "fuser_coverage": lambda: coverage_rows(fusions()),
        "path_statistics": lambda: path_statistics_rows(paths()),
        "team": lambda: team_rows(team, paths(), _placed_by_smoothed(run, fusions())),
        "team_pairs": lambda: team_pair_rows(
            team, run.pair_table("errors"), settings.merge.aligner
        ),
        "map_fits": lambda: fused_landmarks.map_fit_rows(team),
        "landmark_nees": lambda: fused_landmarks.landmark_nees_rows(
            team, settings.true_pair_radius_m
        ),
    }
    of_all |= dict.fromkeys(judged, list) if run.no_truth else judged
    return of_all | {
        "frame_times": lambda: _frame_times(run),
        "findings": lambda: finding_rows(run),
        "smoother": lambda: smoother_rows(smoothed()),
        "team_edges": lambda: fused_landmarks.team_edge_rows(team),
        "timings": lambda: [
            {"stage": stage.name, "name": f"{stage.key}:{name}", "elapsed_s": seconds}
            for stage in run.folders()
            for name, seconds in stage.figures().items()
        ],
    }


def history_makers(run: JudgedRun, team: FusedTeam) -> dict[str, Maker]:
    """What makes the tables that a result has beside these, by their names, likewise."""
    no_truth = {"true_pairs": list} if run.no_truth else {}
    return {
        "aligner_timings": lambda: run.pair_table("aligner_timings"),
        "tracks": lambda: _tracks(run),
        "true_pairs": lambda: true_pair_rows(team, run.settings.true_pair_radius_m),
        "map_history": lambda: map_history_rows(team),
        "fused_history": lambda: fused_history_rows(team, run.settings.merge),
    } | no_truth


def _fused_map_rows(run: JudgedRun, fusions: Sequence[JudgedFusion]) -> pd.DataFrame:
    named = [fusion for fusion in fusions if fusion.fuser == run.scenario.merge.fuser]
    last = max(named, key=lambda fusion: fusion.iteration, default=None)
    return pd.DataFrame() if last is None else fused_landmarks.fused_rows(last.team())


def _placed_by_smoothed(run: JudgedRun, fusions: Sequence[JudgedFusion]) -> Float | None:
    """T_first_map (M, 3) of the last map of a fuser of smoothed maps; of `merge.fuser` if it is."""
    takes = [fusion for fusion in fusions if make_fuser(fusion.fuser).smoothed]
    named = [fusion for fusion in takes if fusion.fuser == run.scenario.merge.fuser]
    last = max(named or takes, key=lambda fusion: fusion.iteration, default=None)
    return None if last is None else last.fusion.T_first_map


def _paths(run: JudgedRun, smoothed: Sequence[SmoothedRobot]) -> pd.DataFrame:
    """Rows of the table `paths`, with the smoothed path beside its columns."""
    paths = []
    for stages, each in zip(run.pipeline.robots, smoothed, strict=True):
        poses = read_rows(run.store.path(stages.slam) / "poses.parquet", slam.POSES)
        poses, log = poses.assign(robot=each.robot.name), run.logs[stages.name]
        rows = robot_paths(poses, log.odometry, each.robot.path)
        names = [f"smoothed_{name}" for name in POSE_FIELDS]
        paths.append(rows.assign(**named_columns(names, each.last_path)))
    return pd.concat(paths, ignore_index=True)


def _frame_times(run: JudgedRun) -> pd.DataFrame:
    parts = [
        pd.DataFrame({"robot": name, "iteration": np.arange(len(log)), "time_s": log.time_s})
        for name, log in run.logs.items()
    ]
    return pd.concat(parts, ignore_index=True)


def _clouds(run: JudgedRun) -> pd.DataFrame:
    folders = ((each.name, run.robot_folders(each).slam) for each in run.pipeline.robots)
    clouds = [
        read_rows(folder / "clouds.parquet", slam.CLOUDS).assign(robot=name)
        for name, folder in folders
    ]
    return pd.concat(clouds, ignore_index=True)


def _tracks(run: JudgedRun) -> pd.DataFrame:
    files = [run.store.path(robot.observed) / "tracks.parquet" for robot in run.pipeline.simulated]
    return pd.concat([pd.DataFrame(), *(tables.read(file, "tracks") for file in files)])
