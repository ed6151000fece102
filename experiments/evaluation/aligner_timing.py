"""Times of aligners on maps of growing overlap: the table `aligner_timings`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.evaluation import tables
from experiments.evaluation.alignment_errors import MapPair
from experiments.evaluation.truth import (
    common_landmarks,
)
from experiments.plugins.discovery import callable_aligner
from experiments.scenario.seeds import generator
from experiments.scenario.settings import AnyScenario
from mapfusion.verification.registration import Aligner

_PERCENTILES = {"elapsed_low_s": 10, "elapsed_s": 50, "elapsed_high_s": 90}
_WARM_UP = "warm-up"  # name of the random generators of calls that are not timed


@dataclass(frozen=True)
class AlignerTiming:
    """Aligners ready for timing on the maps of one pair of robots.

    Attributes:
        seed: seed of the scenario.
        repeats: number of timings of each aligner on each pair of maps.
        aligners: aligners by name; their kernels are compiled and their processes run.
        maps: pairs of maps, evenly spread over the run.
        n_common: number of common landmarks of each pair of maps; UNKNOWN without truth.
    """

    seed: int
    repeats: int
    aligners: Mapping[str, Aligner]
    maps: Sequence[MapPair]
    n_common: Sequence[int]

    @classmethod
    def of(cls, scenario: AnyScenario, map_pairs: Sequence[MapPair]) -> "AlignerTiming":
        """Choose pairs of maps of two robots and warm up all aligners.

        Other processes may be busy meanwhile.
        """
        settings = scenario.evaluate
        spread = np.linspace(0, len(map_pairs) - 1, settings.timing_points)
        maps = [map_pairs[k] for k in np.unique(spread.round().astype(int))]
        aligners = {
            entry.name: callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
            for entry in scenario.align.aligners
        }
        n_common = []
        for pair in maps:
            points_a, points_b = pair.points_world_m
            known = all(np.isfinite(own).any() for own in (points_a, points_b))
            radius_m = settings.true_pair_radius_m
            n_common.append(
                common_landmarks(points_a, points_b, radius_m) if known else tables.UNKNOWN
            )
        ready = cls(scenario.seed, settings.timing_repeats, aligners, maps, n_common)
        for smallest_or_largest in (maps[0], maps[-1]):  # some aligners treat few pairs apart
            for name in aligners:
                ready._call(name, smallest_or_largest, _WARM_UP)
        return ready

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows of the table `aligner_timings`; nothing else may run meanwhile."""
        rows, elapsed_s = [], []
        for maps, n_common in zip(self.maps, self.n_common, strict=True):
            self._call(next(iter(self.aligners)), maps, _WARM_UP)  # load the maps into CPU caches
            counts = {"n_correspondences": len(maps.offered), "n_common": n_common}
            for name in self.aligners:
                rows.append(maps.keys | counts | {"aligner": name})
                elapsed_s.append([self._call(name, maps, k) for k in range(self.repeats)])
        times = np.percentile(elapsed_s, list(_PERCENTILES.values()), axis=1).T
        named = (dict(zip(_PERCENTILES, each, strict=True)) for each in times.tolist())
        return [row | each for row, each in zip(rows, named, strict=True)]

    def _call(self, name: str, maps: MapPair, repeat: int | str) -> float:
        """Call an aligner and return its time in s."""
        rng = generator(self.seed, "timing", name, repeat)
        return self.aligners[name].align(*maps.maps, maps.offered, rng).elapsed_s
