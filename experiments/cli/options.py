"""What several commands take and give: options, exit codes."""

import os
from pathlib import Path
from typing import Annotated

import typer

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
EXIT_DEFECT = 70  # EX_SOFTWARE of sysexits.h: an error of ours
RESULTS = Path("results")
# Those that this process may use.
ALL_CORES = (
    len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
)

# Those without a default in a command's signature have theirs here.
ScenarioNames = Annotated[
    list[str],
    typer.Argument(metavar="SCENARIO...", help="Scenario files, or names or tags of the suite."),
]
ScenarioPath = Annotated[Path, typer.Argument(metavar="SCENARIO", help="Scenario file (YAML).")]
SectionsOf = Annotated[
    Path | None, typer.Option("--scenario", help="Scenario whose sections to use.")
]
ResultFolder = Annotated[Path, typer.Argument(metavar="RESULT", help="A run's result folder.")]
Overrides = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        default_factory=list,
        show_default=False,
        help="Replaces a value, e.g. evaluate.every=1.",
    ),
]
ImportOverrides = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        default_factory=list,
        show_default=False,
        help="Replaces a setting of the importer, e.g. its noise: range_sigma_m=0.2.",
    ),
]
Seed = Annotated[int | None, typer.Option(help="Replaces the scenario's seed.", min=0)]
OwnSeed = Annotated[int, typer.Option("--seed", help="Of all that is random.", min=0)]
Seeds = Annotated[str, typer.Option(help="A seed, a range 0..4 or a list 0,2,5.")]
Jobs = Annotated[int, typer.Option(help="Processes.", min=1, show_default="all cores")]
Fresh = Annotated[bool, typer.Option("--fresh", help="Compute again what is stored already.")]
Results = Annotated[Path, typer.Option(help="Folder that results go to.", show_default="results")]
Output = Annotated[Path, typer.Option("--output", "-o", help="File or folder to write.")]
OutputFolder = Annotated[Path | None, typer.Option("--output", "-o", help="Folder to write.")]
