"""How far off a team's map and paths are, at each iteration, for each strategy."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from experiments.evaluation.alignment_errors import EvaluatedRobot, first_shared_iteration
from experiments.evaluation.fused_map_errors import GivenMap, JudgedFusion
from experiments.evaluation.map_consistency import rmse
from experiments.evaluation.path_errors import STATISTICS
from experiments.evaluation.smoothed_robots import SmoothedRobot
from experiments.evaluation.tables import UNKNOWN
from experiments.evaluation.team_errors import PlacedPath, team_ate_m
from experiments.pipeline.stages.fuse import read_fusions
from experiments.studies.independence.recorded_teams import RecordedTeam
from experiments.studies.independence.robot_costs import read_paths
from experiments.studies.independence.strategies import STRATEGIES
from mapfusion.fusion.fusers import make_fuser
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import IDENTITY

_Paths = Mapping[str, Mapping[int, Float]]  # (T, 3) by robot and iteration


@dataclass(frozen=True)
class _Known:
    """All that is known of a team whose maps are judged."""

    robots: list[EvaluatedRobot]
    smoothed: list[SmoothedRobot]
    filter_paths: _Paths


def error_rows(team: RecordedTeam) -> Iterator[dict[str, Any]]:
    """Errors of map and paths; NaN where no two robots' maps were merged."""
    run, names = team.run, list(team.by_robot)
    robots = run.load_robots()
    filter_paths = dict[str, Mapping[int, Float]]()
    for stage in team.by_robot.values():
        filter_paths |= read_paths(team.folder(stage))
    known = _Known(robots, run.load_smoothed(robots), filter_paths)
    first = first_shared_iteration(robots, run.scenario.evaluate.true_pair_radius_m)
    about = {"first_shared": UNKNOWN if first is None else first}
    judged: dict[tuple[str, int], dict[str, Any]] = {}
    for fuser, stage in team.by_fuser.items():
        folder = team.folder(stage)
        anew = read_paths(folder)
        for k, fusion in read_fusions(folder, names).items():
            beside = known.smoothed if make_fuser(fuser).smoothed else [None] * len(robots)
            given = [GivenMap.at(*both, k) for both in zip(robots, beside, strict=True)]
            judged[fuser, k] = _errors(JudgedFusion(fuser, k, fusion, given), known, anew)
    for strategy in STRATEGIES:
        for k in team.iterations:
            row = {"strategy": strategy.name, "iteration": k} | about
            yield row | judged[strategy.fuser, k]


def _errors(fusion: JudgedFusion, known: _Known, anew: _Paths) -> dict[str, Any]:
    """One fused map's; paths in its frame, where its fuser found them anew, are taken first."""
    fused = fusion.fusion
    row = {"n_merged": len(fused.members), "fallback": fusion.fallback}
    if len(fused.members) < 2:
        return row
    fit, paths = fusion.fit, []
    for k in fused.members:
        robot, T_first_map = known.robots[k], fused.T_first_map[k]
        poses = anew.get(robot.name, {}).get(fusion.iteration)
        if poses is None:
            poses = _own_path(known, fusion, int(k))
        else:
            T_first_map = IDENTITY
        truth = robot.path
        placed = PlacedPath(poses, truth.T_map_robot[: len(poses)], T_first_map, truth.T_world_map)
        paths.append(placed)
    return row | {
        "n_landmarks": len(fused.landmarks),
        "landmark_rmse_m": rmse(fit.frame_error_m[~fit.gross]),
        "fitted_rmse_m": fit.rmse_m,
        "gross_share": fit.gross_share,
        "path_rmse_m": STATISTICS["rmse"](team_ate_m(paths)),
    }


def _own_path(known: _Known, fusion: JudgedFusion, place: int) -> Float:
    """A robot's path that belongs to the map it gave, (T, 3): the smoother's or the filter's."""
    given, smoothed = fusion.given[place], known.smoothed[place]
    for k, landmarks in smoothed.maps.items():
        if given.landmarks is landmarks:
            return smoothed.paths[k]
    own = known.filter_paths[given.robot.name]
    return own[max(k for k in own if k <= fusion.iteration)]
