"""All kernels, called in this process on small arrays; says which were not.

`test_bounds.py` starts it with Numba's bounds checks on. To compile is what takes the time, so it
calls what reaches many kernels at once, and each with one kind of arguments where that is enough.
"""

import importlib
import pkgutil
import sys
import tempfile
from itertools import product
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import njit
from numba.core.registry import CPUDispatcher

import experiments
import mapfusion
import sim
from experiments.judge.result import run_scenario
from experiments.run.code_version import SOURCE_ROOT
from experiments.scenario.settings import Simulation
from experiments.scenario.yaml_input import read_mapping
from mapfusion.align.max_clique import everyone, larger_clique
from mapfusion.align.registry import ALIGNERS
from mapfusion.camera import StereoCamera
from sim.floorplan import FloorPlan, Wall
from sim.raycast.caster import RayCaster
from sim.world import write_faces
from tests.experiments.study.refusal.test_refusal import (
    test_calibration_counts_every_motion_of_two_pairs,
)
from tests.helpers.tiny_scenario import SHORT
from tests.mapfusion.align.test_max_clique import on_bits, random_graph
from tests.mapfusion.fastslam.test_filter_twin import test_equals_the_filter_that_copies
from tests.mapfusion.fastslam.test_particles import (
    test_near_finds_the_gates_that_touch_a_box_and_no_freed_slot,
    test_without_landmarks_nothing_is_near,
)
from tests.mapfusion.smoother.test_smooth import test_equals_the_dense_twin


@njit
def _beyond(values: np.ndarray) -> float:
    return values[len(values)]


def kernels() -> dict[str, CPUDispatcher]:
    """All kernels of ours by name."""
    found = {}
    for package in (mapfusion, experiments, sim):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            path = SOURCE_ROOT.joinpath(*module.name.split(".")).with_suffix(".py")
            if not path.is_file() or "njit" not in path.read_text(encoding="utf-8"):
                continue
            for name, value in vars(importlib.import_module(module.name)).items():
                # what is inlined by Numba is compiled, and checked, within its callers
                inlined = isinstance(value, CPUDispatcher) and "inline" in value.targetoptions
                if isinstance(value, CPUDispatcher) and not inlined:
                    found[f"{value.py_func.__module__}.{name}"] = value
    return found


def run_all_aligners(folder: Path) -> None:
    """A run from the cameras to the tables, with all of our methods."""
    path = folder / "short.yaml"
    path.write_text(SHORT, encoding="utf-8")
    asked = read_mapping(path)
    asked["align"]["aligners"] = [{"name": name, "method": name} for name in ALIGNERS]
    run_scenario(Simulation.model_validate(asked), folder, 1, lambda *_: None)


def draw_robots(folder: Path) -> None:
    """A wall that ends in the picture, a robot before it, and one that reaches the lens."""
    wall = Wall(np.array([[2, -1], [2, 0.5], [3, 0.5]]))
    write_faces(folder, FloorPlan((wall,)), np.random.default_rng(0))
    others = np.array([[1.4, 0.0, 0.5], [0.4, 0.3, 1.0]])
    camera = StereoCamera(160, 120, 144.0)
    RayCaster(folder, camera).depth_m(np.zeros(3), 0.0, others)
    for sampling in ("footprint", "middle"):
        RayCaster(folder, camera, sampling).grey(np.zeros(3), 0.0, others)


def main() -> int:
    """Exit code 1 where a kernel was not reached."""
    assert numba.config.BOUNDSCHECK
    with pytest.raises(IndexError):  # the checks are on
        _beyond(np.zeros(3))
    # particles that have less than a handful of landmarks, and so of slots for them
    for ways in product(["gate", "descriptor", "label"], [True, False], ["informed", "motion"]):
        association, planar, proposal = ways
        test_equals_the_filter_that_copies(association, planar, 0.5, proposal)
    test_near_finds_the_gates_that_touch_a_box_and_no_freed_slot()
    test_without_landmarks_nothing_is_near()
    test_equals_the_dense_twin(8, 90, planar=False)
    larger_clique(on_bits(random_graph(0, 130, 0.3)), everyone(130), 0, 1000)
    test_calibration_counts_every_motion_of_two_pairs()
    with tempfile.TemporaryDirectory() as folder:
        run_all_aligners(Path(folder))
        draw_robots(Path(folder, "faces"))
    found = kernels()
    cached = [name for name, kernel in found.items() if kernel.stats.cache_hits]
    assert not cached, f"not compiled with checks: {cached}"
    unreached = sorted(name for name, kernel in found.items() if not kernel.signatures)
    sys.stdout.write(f"{len(found)} kernels, not reached: {' '.join(unreached) or 'none'}\n")
    return bool(unreached)


if __name__ == "__main__":
    sys.exit(main())
