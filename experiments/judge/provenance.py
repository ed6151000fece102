"""Where a result came from: enough to make it again, or to see why it cannot be."""

import platform
from datetime import UTC, datetime
from typing import Any

from experiments.judge.judged_run import JudgedRun
from experiments.run.code_version import library_versions
from experiments.scenario.settings import AnyScenario, Simulation
from mapfusion.align.registry import find_method
from sim.renderer import renderer_name

RESULT_SCHEMA_VERSION = 1


def renderer(scenario: AnyScenario) -> str:
    """What made the pictures."""
    if isinstance(scenario, Simulation):
        return renderer_name(scenario.render.renderer)
    return "none (imported logs)"


def provenance(run: JudgedRun) -> dict[str, Any]:
    """JSON-able description of a run."""
    return {
        "schema_version": RESULT_SCHEMA_VERSION,
        "scenario": run.scenario.name,
        "seed": run.scenario.seed,
        "renderer": renderer(run.scenario),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "libraries": library_versions(),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "others_aligners": {
            entry.name: origin
            for entry in run.scenario.align.aligners
            if (origin := find_method(entry.method).origin())
        },
        "stages": {f"{folder.name}/{folder.key}": folder.finished for folder in run.folders()},
    }
