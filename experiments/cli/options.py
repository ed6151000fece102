"""What several commands take and give: options, exit codes."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from experiments.show.plain_text import plain

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
EXIT_DEFECT = 70  # EX_SOFTWARE of sysexits.h: an error of ours
RESULTS = Path("results")
# Panels of the help, in the order of a user's day.
RUN, LOOK, STEPS = "Run", "Look and compare", "Your own maps, logs and recordings"
# Those that this process may use.
ALL_CORES = (
    len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
)

# Those without a default in a command's signature have theirs here.
ScenarioNames = Annotated[
    list[str],
    typer.Argument(metavar="SCENARIO...", help="Scenario files, or names or tags of the suite."),
]
OneScenario = Annotated[
    str, typer.Argument(metavar="SCENARIO", help="Scenario file, or a name of the suite.")
]
SettingsOf = Annotated[
    str | None,
    typer.Option("--scenario", metavar="SCENARIO", help="File or name whose settings to use."),
]
ResultFolder = Annotated[Path, typer.Argument(metavar="RESULT", help="A run's result folder.")]
Overrides = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        default_factory=list,
        show_default=False,
        help="Replaces a value of the scenario, e.g. slam.filter.n_particles=50.",
    ),
]
ImportOverrides = Annotated[
    list[str],
    typer.Option(
        "--param",
        metavar="KEY=VALUE",
        default_factory=list,
        show_default=False,
        help="Replaces a setting of the importer, e.g. its noise: range_sigma_m=0.2.",
    ),
]
Format = Annotated[
    str,
    typer.Option(
        "--format",
        metavar="FORMAT",
        help="tum, kitti (paths), g2o (graph), ply (maps), rerun of results; "
        "log, euroc, kitti, rosbag, rosbag2 of runs.",
    ),
]
Seed = Annotated[int | None, typer.Option(help="Replaces the scenario's seed (0).", min=0)]
Seeds = Annotated[str, typer.Option(help="A seed, a range 0..4 or a list 0,2,5.")]
Jobs = Annotated[int, typer.Option(help="Processes.", min=1, show_default="all cores")]
Fresh = Annotated[bool, typer.Option("--fresh", help="Compute again what is stored already.")]
Results = Annotated[Path, typer.Option(help="Folder that results go to.", show_default="results")]
Output = Annotated[Path, typer.Option("--output", "-o", help="File or folder to write.")]
OutputFolder = Annotated[Path | None, typer.Option("--output", "-o", help="Folder to write.")]
DocumentFile = Annotated[
    Path | None, typer.Option("--output", "-o", help="File for what --json prints.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document instead.")]


def complain(text: str) -> None:
    """Tell what is wrong, in one line whatever was quoted."""
    # to this stream, which replaces what the terminal lacks; `err=True` may open another
    typer.echo(f"mapfusion: {plain(' '.join(text.split()))}", file=sys.stderr)
