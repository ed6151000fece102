"""The maps at each evaluated iteration, small enough to be kept with a result.

The stages keep them whole in the store; what leaves with the result folder is what one needs to
look at them in plan: positions, plane covariances, which correspondences were true, and what the
landmarks that an accepted alignment joined were fused to.
"""

from dataclasses import replace

import numpy as np
import pandas as pd

from experiments.judge.errors import MetMaps
from experiments.judge.fused_landmarks import FusedTeam
from experiments.scenario.settings import AnyScenario, Merge
from mapfusion.align.correspondences import Correspondences
from mapfusion.landmark_map import LandmarkMap
from mapfusion.merge import merge
from mapfusion.storage import point_columns


def history_tables(team: FusedTeam, scenario: AnyScenario) -> dict[str, pd.DataFrame]:
    """The tables `map_history`, `true_pairs` and `fused_history`."""
    maps = [
        _plan_rows(landmarks).assign(robot=robot.name, iteration=k)
        for robot in team.robots
        for k, landmarks in robot.maps.items()
    ]
    radius_m = scenario.evaluate.true_pair_radius_m
    true_pairs = [
        {
            **met.names,
            "n_correspondences": len(met.offered),
            "true_pair": np.packbits(met.is_true(radius_m)).tobytes(),
        }
        for met in team.met
    ]
    fused = [_joined_rows(met, scenario.merge) for met in team.met]
    return {
        "map_history": pd.concat(maps, ignore_index=True),
        "true_pairs": pd.DataFrame(true_pairs),
        "fused_history": pd.concat(fused, ignore_index=True) if fused else pd.DataFrame(),
    }


def _plan_rows(landmarks: LandmarkMap) -> pd.DataFrame:
    columns = point_columns(landmarks.position_m, landmarks.covariance_m2)
    return pd.DataFrame({"landmark": np.arange(len(landmarks)), **columns})


def _joined_rows(met: MetMaps, settings: Merge) -> pd.DataFrame:
    """The inliers of the merging aligner's first repetition, fused; none where it was refused.

    Only they are given to the merge: its second pass, which looks for what they missed, takes ten
    times as long as all the rest of this table.
    """
    (map_a, map_b), alignment = met.maps, met.alignment(settings.aligner)
    pairs = met.offered[np.flatnonzero(alignment.inlier & alignment.ok)]
    fused, each = map_a[pairs.index_a], np.arange(len(pairs))
    if alignment.ok:
        fused = merge(
            [fused, map_b[pairs.index_b]],
            [replace(alignment, inlier=np.ones(len(each), dtype=bool))],
            [Correspondences(each, each, pairs.distance)],
            settings.parameters,
        ).landmarks
    joined = {"landmark_a": pairs.index_a, "landmark_b": pairs.index_b}
    return _plan_rows(fused).assign(**met.names, **joined)
