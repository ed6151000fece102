"""Maps over a run's iterations, as one looks at them in plan.

The stages keep the maps whole in the store; what leaves with the result is what one needs to look
at them in plan.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.errors import MetMaps
from experiments.judge.fused_landmarks import FusedTeam, MergeSettings
from mapfusion.align.correspondences import Correspondences
from mapfusion.aligned_landmarks import AlignedLandmarks
from mapfusion.fuse.kalman import kalman_fused
from mapfusion.fuse.sequential import landmarks_in_turn
from mapfusion.landmark_map import LandmarkMap
from mapfusion.merge import connect
from mapfusion.storage import point_columns


def map_history_rows(team: FusedTeam) -> pd.DataFrame:
    """Rows of the table `map_history`."""
    maps = [
        (
            {"robot": robot.name, "iteration": k},
            {"landmark": np.arange(len(landmarks))} | _points(landmarks),
        )
        for robot in team.robots
        for k, landmarks in robot.maps.items()
    ]
    return _rows(maps)


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
    return _rows([(met.names, _joined(met, settings)) for met in team.met])


def _rows(parts: Sequence[tuple[dict[str, Any], dict[str, np.ndarray]]]) -> pd.DataFrame:
    """Rows of parts: what is said of all rows of a part, and columns; these are the same of all.

    All in one frame at once: to make one of each part takes many times as long.
    """
    if not parts:
        return pd.DataFrame()
    said = pd.DataFrame([named for named, _ in parts])
    n_rows = [len(next(iter(columns.values()))) for _, columns in parts]
    joined = {name: np.concatenate([columns[name] for _, columns in parts]) for name in parts[0][1]}
    return pd.DataFrame({name: said[name].to_numpy().repeat(n_rows) for name in said} | joined)


def _points(landmarks: LandmarkMap | AlignedLandmarks) -> dict[str, np.ndarray]:
    return point_columns(landmarks.position_m, landmarks.covariance_m2)


def _joined(met: MetMaps, settings: MergeSettings) -> dict[str, np.ndarray]:
    """The inliers of the merging aligner's first repetition, fused; none where it was refused.

    As `PAPERS` fuses them, and only they are given: the second pass, which looks for what they
    missed, takes ten times as long as all the rest of this table.
    """
    pair = met.aligned(settings.aligner, 0, 1)
    pairs = met.offered[np.flatnonzero(pair.alignment.inlier & pair.alignment.ok)]
    # all are paired already: nobody looks at their descriptors
    map_a, map_b = (replace(own, descriptor=None) for own in met.maps)
    fused, each = map_a[pairs.index_a], np.arange(len(pairs))
    if pair.alignment.ok:
        alone = replace(
            pair,
            alignment=replace(pair.alignment, inlier=np.ones(len(each), dtype=bool)),
            correspondences=Correspondences(each, each, pairs.distance),
        )
        both = connect([fused, map_b[pairs.index_b]], [alone], settings.parameters.team)
        fused = landmarks_in_turn(
            both.components[0], settings.parameters, kalman_fused, use_drift=True
        )
    return {"landmark_a": pairs.index_a, "landmark_b": pairs.index_b} | _points(fused)
