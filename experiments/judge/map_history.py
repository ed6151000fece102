"""Maps over a run's iterations, as one looks at them in plan.

The stages keep the maps whole in the store; what leaves with the result is what one needs to look
at them in plan.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.errors import MetMaps
from experiments.judge.fused_landmarks import PAPERS, FusedTeam, MergeSettings
from mapfusion.align.correspondences import Correspondences
from mapfusion.landmark_map import LandmarkMap
from mapfusion.merge import merge
from mapfusion.storage import point_columns


def map_history_rows(team: FusedTeam) -> pd.DataFrame:
    """Rows of the table `map_history`."""
    maps = [
        _plan_rows(landmarks).assign(robot=robot.name, iteration=k)
        for robot in team.robots
        for k, landmarks in robot.maps.items()
    ]
    return pd.concat(maps, ignore_index=True)


def true_pair_rows(team: FusedTeam, radius_m: float) -> list[dict[str, Any]]:
    """Rows of the table `true_pairs`."""
    return [
        met.names
        | {
            "n_correspondences": len(met.offered),
            "true_pair": np.packbits(met.is_true(radius_m)).tobytes(),
        }
        for met in team.met
    ]


def fused_history_rows(team: FusedTeam, settings: MergeSettings) -> pd.DataFrame:
    """Rows of the table `fused_history`."""
    fused = [_joined_rows(met, settings) for met in team.met]
    return pd.concat(fused, ignore_index=True) if fused else pd.DataFrame()


def _plan_rows(landmarks: LandmarkMap) -> pd.DataFrame:
    columns = point_columns(landmarks.position_m, landmarks.covariance_m2)
    return pd.DataFrame({"landmark": np.arange(len(landmarks)), **columns})


def _joined_rows(met: MetMaps, settings: MergeSettings) -> pd.DataFrame:
    """The inliers of the merging aligner's first repetition, fused; none where it was refused.

    Only they are given to the merge: its second pass, which looks for what they missed, takes ten
    times as long as all the rest of this table.
    """
    (map_a, map_b), pair = met.maps, met.aligned(settings.aligner, 0, 1)
    pairs = met.offered[np.flatnonzero(pair.alignment.inlier & pair.alignment.ok)]
    fused, each = map_a[pairs.index_a], np.arange(len(pairs))
    if pair.alignment.ok:
        alone = replace(
            pair,
            alignment=replace(pair.alignment, inlier=np.ones(len(each), dtype=bool)),
            correspondences=Correspondences(each, each, pairs.distance),
        )
        both = [fused, map_b[pairs.index_b]]
        fused = merge(both, [alone], settings.parameters, PAPERS).fused[0].landmarks
    joined = {"landmark_a": pairs.index_a, "landmark_b": pairs.index_b}
    return _plan_rows(fused).assign(**met.names, **joined)
