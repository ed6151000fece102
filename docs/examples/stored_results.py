"""Statistics of a sweep of stored results.

`mapfusion statistics` writes tables as CSV files. Those of the hard scenarios lie in the
repository, in `results/reference/hard`. The plot shows the share of right alignments at the end,
with 95 % intervals.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd

table = pd.read_csv(Path(sys.argv[1]) / "results/reference/hard/success_at_the_end.csv")
table = table[table["aligner"].isin(["ransac", "icp", "oracle"])]
shown = ["scenario", "aligner", "n_runs", "refined_success"]
print(table[shown].round(2).to_string(index=False))

figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
names = list(table["scenario"].unique())
for k, (aligner, rows) in enumerate(table.groupby("aligner")):
    share = rows["refined_success"]
    below, above = share - rows["refined_success_low"], rows["refined_success_high"] - share
    where = [names.index(name) + 0.2 * (k - 1) for name in rows["scenario"]]
    axes.errorbar(where, share, [below.clip(0), above.clip(0)], fmt="o", capsize=3, label=aligner)
axes.set_xticks(range(len(names)), names, rotation=30)
axes.set_ylabel("share of right alignments")
axes.legend()
figure.savefig("picture.png", dpi=100)
