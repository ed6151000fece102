"""Drawn maps of several robots with their truth, fused and ready to be judged."""

from experiments.evaluation.map_errors import EvaluatedFusion, GivenMap
from experiments.evaluation.truth import EvaluatedRobot, PathTruth
from mapfusion.fusion.fusers import MergeParameters, make_fuser
from mapfusion.fusion.merge import merge
from mapfusion.robot_log import RobotTruth
from tests.mapfusion.fusion.drawn_maps import DrawnTeam

PARTS, K = [slice(0, 40), slice(20, 60), slice(30, 70)], 5
BENT_M = 0.01  # little enough for no landmark to be gross


def evaluated_robots(team: DrawnTeam) -> list[EvaluatedRobot]:
    """The maps at iteration K, each in its robot's frame."""
    robots = []
    for k, own in enumerate(team.maps):
        points = team.world_m[team.parts[k]]
        truth = RobotTruth(team.T_world_map[k][None], points)
        robots.append(EvaluatedRobot(f"R{k}", {K: own}, {K: points}, PathTruth.of(truth)))
    return robots


def evaluated_team(team: DrawnTeam, fuser: str = "joint") -> EvaluatedFusion:
    """All maps fused, by a fuser that is given these very maps."""
    fused = merge(team.maps, team.pairs, MergeParameters(), make_fuser(fuser)).fused[0]
    given = [GivenMap.at(robot, None, K) for robot in evaluated_robots(team)]
    return EvaluatedFusion(fuser, K, fused, given)
