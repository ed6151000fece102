"""Maps from pandas, aligned, fused and plotted.

Two robots see one world. The map `south` starts at (2, 1) in the frame of `north`.
"""

import numpy as np
import pandas as pd

import mapfusion

rng = np.random.default_rng(0)
world = pd.DataFrame(rng.uniform(0, 20, (60, 2)), columns=["x_m", "y_m"])
sigma_m = 0.02
maps = []
for seen, start in ((world[:45], [0, 0]), (world[15:], [2, 1])):
    noisy = seen - start + rng.normal(0, sigma_m, seen.shape)
    variances = {"cov_xx_m2": sigma_m**2, "cov_xy_m2": 0.0, "cov_yy_m2": sigma_m**2}
    maps.append(noisy.assign(**variances, label=seen.index))

print(mapfusion.align_maps(*maps).advice)
merged = mapfusion.merge_maps(maps)
print(
    f"{len(maps[0])} and {len(maps[1])} landmarks become {len(merged.fusion.fused[0].landmarks)}."
)
merged.plot().savefig("picture.png", dpi=100)
