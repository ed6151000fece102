"""Stage: a team's maps, or logs, made one by one fuser, and what that costs.

It keeps the fused maps as the stage `fuse` does, and the paths where the fuser finds them anew.
"""

from collections.abc import Sequence

import pandas as pd

from experiments.pipeline.stage import Job
from experiments.pipeline.stages import fuse
from experiments.pipeline.stages.fuse import FuseSettings
from experiments.pipeline.tables import write_rows
from experiments.pipeline.workers import single_threaded
from experiments.studies.independence.measured_work import COSTS_FILE, WORK_COSTS, Meter, cost_row
from experiments.studies.independence.pair_costs import LABEL as LABEL
from experiments.studies.independence.robot_costs import PATHS, PATHS_FILE, path_rows
from mapfusion.fusion.fused_map import FusedMap

FUSION = "fusion"
WRITES = (*fuse.WRITES, COSTS_FILE, PATHS_FILE)


def run(settings: FuseSettings, job: Job) -> None:
    """Fuse at each iteration; write the maps, costs and paths in the fused frame."""
    single_threaded()
    fusions: dict[int, Sequence[FusedMap]] = {}
    costs, paths, warm = [], list[pd.DataFrame](), set[bool]()
    for k, given in fuse.given_teams(settings, job):
        connected = given.connected(settings)
        merged = len(connected.components[0].members) > 1
        if merged not in warm:
            given.fused(connected, settings)  # compiles, and fills caches
            warm.add(merged)
        meter = Meter()
        fusions[k] = given.fused(given.connected(settings), settings)
        costs.append(cost_row(k, FUSION, meter.read()))
        first = fusions[k][0]
        for place, path in zip(first.members, first.paths, strict=False):
            paths.append(path_rows(k, settings.robots[place], path))
    fuse.write_fusions(job.output, fusions, settings.robots)
    write_rows(job.output / COSTS_FILE, WORK_COSTS, pd.DataFrame(costs))
    write_rows(job.output / PATHS_FILE, PATHS, pd.concat(paths) if paths else [])
