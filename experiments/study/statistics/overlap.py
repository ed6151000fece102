"""How much of two maps is common ground, as a share."""

import numpy as np
import pandas as pd

from experiments.study.statistics.run_tables import Runs


def with_overlap_share(maps: pd.DataFrame, runs: Runs) -> pd.DataFrame:
    """Rows of `maps_of` with overlap_share: n_common over the landmarks of the smaller map.

    NaN where the runs have no table `robots`. A robot whose log ended earlier keeps its last map.
    """
    if not runs.has("robots"):
        return maps.assign(overlap_share=np.nan)
    sizes = map_sizes(runs, np.unique(maps["iteration"]))
    for side in "ab":
        own = sizes.rename(columns={"robot": f"robot_{side}", "n_landmarks": f"size_{side}"})
        maps = maps.merge(own, on=["run_id", f"robot_{side}", "iteration"], how="left")
    smaller = maps[["size_a", "size_b"]].min(axis=1)
    # a common landmark at least is in both; maps without any have nothing in common
    share = (maps["n_common"] / smaller.where(smaller > 0)).where(smaller != 0, 0.0)
    return maps.drop(columns=["size_a", "size_b"]).assign(overlap_share=share)


def map_sizes(runs: Runs, iterations: np.ndarray) -> pd.DataFrame:
    """Landmarks of each robot's map at these iterations: run_id, robot, iteration, n_landmarks."""
    parts = []
    for rows in runs.each("robots", ["robot", "iteration", "n_landmarks"]):
        for (run_id, robot), own in rows.groupby(["run_id", "robot"], sort=False):
            known = own.set_index("iteration")["n_landmarks"].sort_index()
            at = known.reindex(iterations, method="ffill")
            part = pd.DataFrame({"run_id": run_id, "robot": robot, "n_landmarks": at.to_numpy()})
            parts.append(part.assign(iteration=iterations))
    return pd.concat(parts, ignore_index=True)
