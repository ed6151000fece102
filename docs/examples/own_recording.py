"""A recording in, a verdict out.

Two robots drive circles that overlap in one yard of numbered posts and measure ranges and bearings.
The commands import their tables and build a map from each log. The smoothed maps state the errors
that their landmarks share, so the alignment has a realistic standard deviation. Robot `east` starts
at (4, 0, 0) in the frame of `west`.
"""

import shlex
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd

import mapfusion
from mapfusion.geometry import se2

rng = np.random.default_rng(0)
posts_m = rng.uniform([-6, -2], [10, 10], (50, 2))
increment = np.array([0.2, 0.0, 0.05])  # a circle with a radius of 4 m
for robot, start in {"west": [0, 0, 0], "east": [4, 0, 0]}.items():
    pose, measured = np.array(start, float), np.zeros(3)
    odometry, ranges = [], []
    for k in range(126):
        if k:
            pose = se2.compose(pose, increment)
            measured = se2.compose(measured, increment + rng.normal(0, [0.004, 0.002, 0.002]))
        odometry.append((0.5 * k, *measured))
        ahead_m = se2.transform_points(se2.inverse(pose), posts_m)
        for label in np.flatnonzero(np.hypot(*ahead_m.T) < 5):
            x, y = ahead_m[label]
            distance, bearing = np.hypot(x, y), np.arctan2(y, x)
            noise = rng.normal(0, [0.02, 0.005])
            ranges.append((0.5 * k, distance + noise[0], bearing + noise[1], label))
    folder = Path("yard", robot)
    folder.mkdir(parents=True)
    columns = ["time_s", "x_m", "y_m", "theta_rad"]
    pd.DataFrame(odometry, columns=columns).to_csv(folder / "odometry.csv", index=False)
    columns = ["time_s", "range_m", "bearing_rad", "label"]
    pd.DataFrame(ranges, columns=columns).to_csv(folder / "ranges.csv", index=False)

noise = "--param range_sigma_m=0.02 --param bearing_sigma_rad=0.005"
for command in (
    f"mapfusion import ranges yard -o logs {noise}",
    "mapfusion slam logs/west -o west.parquet",
    "mapfusion slam logs/east -o east.parquet",
):
    subprocess.run(shlex.split(command), check=True, stdout=subprocess.DEVNULL)

found = mapfusion.align_maps("west.smoothed.parquet", "east.smoothed.parquet")
print(f"Verdict: {found.status}.", found.advice)
found.plot().savefig("picture.png", dpi=100)
