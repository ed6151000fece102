"""Stage: the correspondences of two robots' maps, at each evaluated iteration."""

from dataclasses import dataclass

import pandas as pd

from experiments.run.frames import write_rows
from experiments.run.job import Job
from experiments.run.stage_tables import CORRESPONDENCES
from experiments.run.stages.map_batches import batch_path, pairs_of_maps
from mapfusion.align.correspondences import MatchParameters, match


@dataclass(frozen=True)
class MatchSettings:
    """All that the correspondences depend on, beside the maps."""

    match: MatchParameters
    iterations: tuple[int, ...]


def run(settings: MatchSettings, job: Job) -> None:
    """Find the correspondences of one batch of iterations."""
    made = []
    for k, map_a, map_b in pairs_of_maps(job, settings.iterations):
        pairs = match(map_a, map_b, settings.match)
        columns = {"robot_a": map_a.name, "robot_b": map_b.name, "iteration": k}
        columns |= {"index_a": pairs.index_a, "index_b": pairs.index_b}
        made.append(pd.DataFrame(columns | {"descriptor_distance": pairs.distance}))
    write_rows(batch_path(job.output, job.part), CORRESPONDENCES, pd.concat(made))
