"""Where a result came from: enough to make it again, or to see why it cannot be."""

import platform
from datetime import UTC, datetime
from typing import Any

from experiments.methods.catalogue import find_method
from experiments.pipeline import Plan
from experiments.scenario import Scenario
from experiments.store import library_versions
from sim.renderer import renderer_name

RESULT_SCHEMA_VERSION = 1


def renderer(scenario: Scenario) -> str:
    """What made the pictures."""
    return "none (imported logs)" if scenario.logs else renderer_name(scenario.render.renderer)


def provenance(plan: Plan) -> dict[str, Any]:
    """JSON-able description of a run."""
    return {
        "schema_version": RESULT_SCHEMA_VERSION,
        "scenario": plan.scenario.name,
        "seed": plan.scenario.seed,
        "renderer": renderer(plan.scenario),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "libraries": library_versions(),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "others_aligners": {
            entry.name: origin
            for entry in plan.scenario.align.aligners
            if (origin := find_method(entry.method).origin())
        },
        "stages": {f"{folder.stage}/{folder.key}": folder.finished for folder in plan.folders()},
    }
