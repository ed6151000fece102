"""Commands that do one step on files: record, slam, align, merge, import."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from experiments.cli.options import (
    DEFAULT_RESULTS,
    Jobs,
    Overrides,
    Results,
    ScenarioPath,
    Seed,
    available_cores,
)
from mapfusion.recordings.registry import import_recording


def record(
    scenario: ScenarioPath,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
    seed: Seed = None,
    overrides: Overrides = None,
    jobs: Jobs = None,
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Simulate only: one robot log (with its truth) per robot: `mapfusion record S -o logs`."""
    from experiments.judge import user_files as single
    from experiments.judge.expectations import load_checked
    from experiments.show.terminal.layout import print_paths, progress

    loaded = load_checked(scenario, overrides or (), seed)
    with progress() as show:
        paths = single.record(loaded, output, results, jobs or available_cores(), show)
    print_paths(output, paths)


def slam(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A robot log (folder).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Map file to write.")],
    settings: Annotated[
        Path | None, typer.Option("--scenario", help="Scenario whose `slam` section to use.")
    ] = None,
    overrides: Overrides = None,
    seed: Annotated[int, typer.Option(help="Of the filter's randomness.", min=0)] = 0,
) -> None:
    """Build one robot's map from its log: `mapfusion slam logs/R1 -o R1.parquet`."""
    from experiments.judge import user_files as single
    from experiments.show.terminal.layout import progress
    from experiments.show.terminal.step_screen import print_map

    slam_settings = single.slam_settings(settings, overrides or ())
    with progress() as show:
        landmarks = single.slam(log, slam_settings, seed, show)
    single.save_map(output, landmarks)
    print_map(output, landmarks)


def align(
    map_a: Annotated[Path, typer.Argument(metavar="MAP_A")],
    map_b: Annotated[Path, typer.Argument(metavar="MAP_B")],
    settings: Annotated[
        Path | None, typer.Option("--scenario", help="Scenario whose `align` section to use.")
    ] = None,
    overrides: Overrides = None,
    seed: Annotated[int, typer.Option(help="Of the aligners' randomness.", min=0)] = 0,
) -> None:
    """Estimate T_a_b with every aligner: `mapfusion align R1.parquet R2.parquet`."""
    from experiments.judge import user_files as single
    from experiments.show.terminal.step_screen import print_estimates

    rows = single.align(map_a, map_b, single.align_settings(settings, overrides or ()), seed)
    print_estimates(rows)


def merge(
    maps: Annotated[list[Path], typer.Argument(metavar="MAP MAP...", help="Two maps or more.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Fused map file to write.")],
    settings: Annotated[
        Path | None, typer.Option("--scenario", help="Scenario whose sections to use.")
    ] = None,
    overrides: Overrides = None,
    seed: Annotated[int, typer.Option(help="Of the aligner's randomness.", min=0)] = 0,
) -> None:
    """Fuse maps in the frame of the first: `mapfusion merge A.parquet B.parquet -o F.parquet`."""
    from experiments.judge import user_files as single
    from experiments.show.terminal.step_screen import print_fused

    fused, joined = single.merge(maps, settings, overrides or (), seed)
    single.save_map(output, fused.landmarks)
    print_fused(output, fused, joined)


def import_command(format_name: str) -> Callable[[Path, Path], None]:
    """The command that reads recordings of one format."""

    def command(
        folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The recording.")],
        output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
    ) -> None:
        from experiments.show.terminal.layout import print_paths

        print_paths(output, import_recording(format_name, folder, output))

    return command
