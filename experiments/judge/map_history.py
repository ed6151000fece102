"""The maps at each evaluated iteration, small enough to be kept with a result.

The stages keep them whole in the store; what leaves with the result folder is what one needs to
look at them in plan: positions, plane covariances, which correspondences were true, and what the
landmarks that an accepted alignment joined were fused to.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd

from experiments.judge import tables
from experiments.judge.errors import EvaluatedRobot
from experiments.judge.fused_landmarks import first_repetition
from experiments.judge.truth import true_pairs
from experiments.run.estimates import alignment_of, correspondences_of
from experiments.scenario.settings import AnyScenario, Merge
from mapfusion.align.correspondences import Correspondences
from mapfusion.landmark_map import LandmarkMap
from mapfusion.merge import merge

_KEY = ["robot_a", "robot_b", "iteration"]


def write_history(robots: Sequence[EvaluatedRobot], scenario: AnyScenario, folder: Path) -> None:
    """Write the tables `map_history`, `fused_history` and `true_pairs` of a result.

    Args:
        robots: their maps and true points by iteration.
        scenario: how maps are merged, and what counts as truly the same landmark.
        folder: the result; its `estimates` and `correspondences` are written already.
    """
    maps = [
        _plan_rows(landmarks).assign(robot=robot.name, iteration=k)
        for robot in robots
        for k, landmarks in robot.maps.items()
    ]
    _write(folder, "map_history", maps)
    by_name = {robot.name: robot for robot in robots}
    estimates, offered = (
        tables.read(tables.table_path(folder, name), name)
        for name in ("estimates", "correspondences")
    )
    offered_at = dict(iter(offered.groupby(_KEY)))
    judged, fused = [], []
    for key, group in estimates.groupby(_KEY, sort=False):
        names: dict[str, Any] = dict(zip(_KEY, cast("tuple[Any, ...]", key), strict=True))
        (map_a, points_a), (map_b, points_b) = (
            by_name[names[robot]].at(names["iteration"]) for robot in ("robot_a", "robot_b")
        )
        pairs = correspondences_of(offered_at.get(key, offered.iloc[:0]))
        is_true = true_pairs(
            points_a, points_b, pairs.index_a, pairs.index_b, scenario.evaluate.true_pair_radius_m
        )
        bits = np.packbits(is_true).tobytes()
        judged.append(pd.DataFrame([names | {"n_correspondences": len(pairs), "true_pair": bits}]))
        fused.append(_joined_rows(map_a, map_b, group, pairs, scenario.merge).assign(**names))
    _write(folder, "true_pairs", judged)
    _write(folder, "fused_history", fused)


def _write(folder: Path, name: str, parts: list[pd.DataFrame]) -> None:
    joined = pd.concat(parts, ignore_index=True) if parts else []
    tables.write(tables.table_path(folder, name), name, joined)


def _plan_rows(landmarks: LandmarkMap) -> pd.DataFrame:
    covariance = landmarks.covariance_m2
    return pd.DataFrame(
        {
            "landmark": np.arange(len(landmarks), dtype=np.int32),
            "x_m": landmarks.position_m[:, 0].astype(np.float32),
            "y_m": landmarks.position_m[:, 1].astype(np.float32),
            "cov_xx_m2": covariance[:, 0, 0].astype(np.float32),
            "cov_xy_m2": covariance[:, 0, 1].astype(np.float32),
            "cov_yy_m2": covariance[:, 1, 1].astype(np.float32),
        }
    )


def _joined_rows(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    estimates: pd.DataFrame,
    pairs: Correspondences,
    settings: Merge,
) -> pd.DataFrame:
    """The inliers of the merging aligner's first repetition, fused; none where it was refused.

    Only they are given to the merge: its second pass, which looks for what they missed, takes ten
    times as long as all the rest of this table.
    """
    chosen = first_repetition(estimates, settings.aligner)
    rows_a = rows_b = np.empty(0, dtype=np.int64)
    fused = map_a[rows_a]
    if len(chosen):
        alignment = alignment_of(chosen.iloc[0].to_dict(), len(pairs))
        if alignment.ok:
            rows_a, rows_b = pairs.index_a[alignment.inlier], pairs.index_b[alignment.inlier]
            each = np.arange(len(rows_a))
            fused = merge(
                [map_a[rows_a], map_b[rows_b]],
                [replace(alignment, inlier=np.ones(len(each), dtype=bool))],
                [Correspondences(each, each, pairs.distance[alignment.inlier])],
                settings.parameters,
            ).landmarks
    return _plan_rows(fused).assign(landmark_a=rows_a, landmark_b=rows_b)
