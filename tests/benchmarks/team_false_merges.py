"""Teams of ten robots of whose 45 alignments half are false: how many robots are placed, and where.

`python -m tests.benchmarks.team_false_merges --seeds 100`
"""

import argparse
import sys
import time

import numpy as np

from mapfusion.fusion.team_graph import TeamParameters, Unconfirmed, team_graph
from tests.mapfusion.fusion.teams import falsely_placed, team


def main() -> None:
    """Print a line for each kind of false alignments and each way with unconfirmed ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--robots", type=int, default=10)
    given = parser.parse_args()
    for kind in ("independent", "groups", "shifts"):
        for unconfirmed in Unconfirmed:
            false, largest, seconds = 0, [], []
            for seed in range(given.seeds):
                met = team(seed, kind, given.robots)
                start = time.perf_counter()
                found = team_graph(met.relations, TeamParameters(unconfirmed))
                seconds.append(time.perf_counter() - start)
                false += len(falsely_placed(found, met.T_world_robot)) > 0
                largest.append(np.mean(found.component == 0))
            sys.stdout.write(
                f"{kind:12} {unconfirmed}: {false} of {given.seeds} teams with a false merge, "
                f"{np.mean(largest):.1%} of the robots in the largest component, "
                f"{np.median(seconds):.2f} s (at most {max(seconds):.2f})\n"
            )


if __name__ == "__main__":
    main()
