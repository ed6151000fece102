"""How long aligners take on two robots' maps of growing overlap: warmed, repeated, serially."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.judge import tables
from experiments.judge.errors import MetMaps
from experiments.judge.truth import common_landmarks
from experiments.methods.aligner_calls import callable_aligner
from experiments.scenario.randomness import generator
from experiments.scenario.settings import AnyScenario
from mapfusion.align.registration import Aligner

_PERCENTILES = {"elapsed_low_s": 10, "elapsed_s": 50, "elapsed_high_s": 90}
_WARM_UP = "warm-up"  # names the generators of calls that are not timed


@dataclass(frozen=True)
class AlignerTiming:
    """Aligners made ready to be timed on the maps of one pair of robots.

    Attributes:
        seed: of the scenario.
        repeats: timings of each aligner on each maps.
        aligners: by name; what they run is compiled and loaded.
        maps: evenly spread over the run.
        n_common: landmarks that truly correspond, of each of these; UNKNOWN without truth.
    """

    seed: int
    repeats: int
    aligners: Mapping[str, Aligner]
    maps: Sequence[MetMaps]
    n_common: Sequence[int]

    @classmethod
    def of(cls, scenario: AnyScenario, met: Sequence[MetMaps]) -> "AlignerTiming":
        """Of the pair's maps at all iterations; other work may go on beside."""
        settings = scenario.evaluate
        spread = np.linspace(0, len(met) - 1, settings.timing_points)
        maps = [met[k] for k in np.unique(spread.round().astype(int))]
        aligners = {
            entry.name: callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
            for entry in scenario.align.aligners
        }
        n_common = [_n_common(each, settings.true_pair_radius_m) for each in maps]
        ready = cls(scenario.seed, settings.timing_repeats, aligners, maps, n_common)
        for fewest_or_most in (maps[0], maps[-1]):  # of little, some turn to other code
            for name in aligners:
                ready._call(name, fewest_or_most, _WARM_UP)
        return ready

    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table `aligner_timings`; nothing else may be running."""
        rows, elapsed_s = [], []
        for maps, n_common in zip(self.maps, self.n_common, strict=True):
            self._call(next(iter(self.aligners)), maps, _WARM_UP)  # the maps into the caches
            of_all = {"n_correspondences": len(maps.offered), "n_common": n_common}
            for name in self.aligners:
                rows.append(maps.names | of_all | {"aligner": name})
                elapsed_s.append([self._call(name, maps, k) for k in range(self.repeats)])
        times = np.percentile(elapsed_s, list(_PERCENTILES.values()), axis=1).T
        named = (dict(zip(_PERCENTILES, each, strict=True)) for each in times.tolist())
        return [row | each for row, each in zip(rows, named, strict=True)]

    def _call(self, name: str, maps: MetMaps, repeat: int | str) -> float:
        """Seconds that an aligner takes."""
        rng = generator(self.seed, "timing", name, repeat)
        return self.aligners[name].align(*maps.maps, maps.offered, rng).elapsed_s


def _n_common(maps: MetMaps, radius_m: float) -> int:
    known = all(np.isfinite(points).any() for points in maps.points_world_m)
    return common_landmarks(*maps.points_world_m, radius_m) if known else tables.UNKNOWN
