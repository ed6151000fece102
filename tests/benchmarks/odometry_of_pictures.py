"""Maps of simulated robots that know their motion by their pictures alone: as sure as they say?

    python -m tests.benchmarks.odometry_of_pictures quick@0 rooms_low@0 opposite@0 rooms_high@1

draws each scenario with its seed by the ray caster, writes the drives as recordings, imports them
without the wheels' odometry, and prints a line for each smoothed map: landmarks, error after a
rigid fit, NEES per degree of freedom (gauge removed) and the share in 95 % ellipses.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from experiments.evaluation.map_consistency import fit_to_truth, relative_consistency
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Simulation
from experiments.scenario.suite import one_scenario
from tests.helpers.by_pictures import Mapped, mapped_by_pictures


def line_of(name: str, each: Mapped) -> float:
    """Prints a map's line; returns its NEES per degree of freedom."""
    fit = fit_to_truth(each.landmarks, each.point_m)
    found = relative_consistency(each.landmarks, fit)
    sys.stdout.write(
        f"{name:16s} {len(each.landmarks):5d} landmarks, {1e3 * fit.rmse_m:5.1f} mm, gross"
        f" {fit.gross_share:.2%}, NEES/dof {found.nees_per_dof:.2f}, in 95 %"
        f" {found.coverage_95:.1%}\n"
    )
    sys.stdout.flush()
    return found.nees_per_dof


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", metavar="SCENARIO@SEED")
    parser.add_argument("--jobs", type=int, default=2)
    asked, nees = parser.parse_args(), []
    for run in asked.runs:
        name, seed = run.split("@")
        settings = ["render.renderer=raycast", f"seed={seed}"]
        scenario = load_scenario(one_scenario(name), settings)
        assert isinstance(scenario, Simulation)
        with tempfile.TemporaryDirectory() as folder:
            maps = mapped_by_pictures(scenario, Path(folder), asked.jobs)
        nees += [line_of(f"{run} {k}", each) for k, each in enumerate(maps, start=1)]
    sys.stdout.write(f"median NEES/dof {np.median(nees):.2f} of {len(nees)} robots\n")


if __name__ == "__main__":
    main()
