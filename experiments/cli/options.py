"""What several commands take and give: options, exit codes."""

import os
from pathlib import Path
from typing import Annotated

import typer

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
DEFAULT_RESULTS = Path("results")

ScenarioNames = Annotated[
    list[str],
    typer.Argument(metavar="SCENARIO...", help="Scenario files, or names or tags of the suite."),
]
ScenarioPath = Annotated[Path, typer.Argument(metavar="SCENARIO", help="Scenario file (YAML).")]
Seed = Annotated[int | None, typer.Option(help="Replaces the scenario's seed.", min=0)]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Replaces a value, e.g. evaluate.every=1."),
]
Jobs = Annotated[int | None, typer.Option(help="Processes; all cores by default.", min=1)]
Fresh = Annotated[bool, typer.Option("--fresh", help="Compute again what is stored already.")]
Results = Annotated[Path, typer.Option(help="Folder that results go to.")]


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
