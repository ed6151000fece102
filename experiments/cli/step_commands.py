"""Commands that do one step on files: record, slam, align, merge, import."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from experiments.cli import options
from mapfusion.recordings.registry import import_recording, settings_class

app = typer.Typer()


@app.command()
def record(
    scenario: options.ScenarioPath,
    *,
    output: options.Output,
    seed: options.Seed = None,
    overrides: options.Overrides,
    jobs: options.Jobs = options.ALL_CORES,
    results: options.Results = options.RESULTS,
) -> None:
    """Simulate only: one robot log (with its truth) per robot: `mapfusion record S -o logs`."""
    from experiments.judge import user_files as single
    from experiments.judge.expectations import load_checked
    from experiments.show.terminal.layout import print_paths, progress

    loaded = load_checked(scenario, overrides, seed)
    with progress() as show:
        paths = single.record(loaded, output, results, jobs, show)
    print_paths(output, paths)


@app.command()
def slam(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A robot log (folder).")],
    *,
    output: options.Output,
    settings: options.SectionsOf = None,
    overrides: options.Overrides,
    seed: options.OwnSeed = 0,
) -> None:
    """Build one robot's map from its log: `mapfusion slam logs/R1 -o R1.parquet`."""
    from experiments.judge import user_files as single
    from experiments.show.terminal import layout

    with layout.progress() as show:
        landmarks = single.slam(log, settings, overrides, seed, show)
    single.save_map(output, landmarks)
    layout.print_lines([f"{len(landmarks)} landmarks of {landmarks.name} in {output}"])


@app.command()
def align(
    map_a: Annotated[Path, typer.Argument(metavar="MAP_A")],
    map_b: Annotated[Path, typer.Argument(metavar="MAP_B")],
    *,
    settings: options.SectionsOf = None,
    overrides: options.Overrides,
    seed: options.OwnSeed = 0,
) -> None:
    """Estimate T_a_b with every aligner: `mapfusion align R1.parquet R2.parquet`."""
    from experiments.judge import user_files as single
    from experiments.show.terminal.step_screen import print_estimates

    print_estimates(single.align((map_a, map_b), settings, overrides, seed))


@app.command()
def merge(
    maps: Annotated[list[Path], typer.Argument(metavar="MAP MAP...", help="Two maps or more.")],
    *,
    output: options.Output,
    settings: options.SectionsOf = None,
    overrides: options.Overrides,
    seed: options.OwnSeed = 0,
) -> None:
    """Fuse maps in the frame of the first: `mapfusion merge A.parquet B.parquet -o F.parquet`."""
    from experiments.judge import user_files as single
    from experiments.show.terminal.step_screen import print_fused

    fused = single.merge(maps, settings, overrides, seed)
    single.save_map(output, fused.landmarks)
    print_fused(output, fused, maps)


def import_command(format_name: str) -> Callable[..., None]:
    """The command that reads recordings of one format; `--set` takes what its settings have."""

    def command(
        folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The recording.")],
        output: options.Output,
        overrides: options.ImportOverrides,
    ) -> None:
        from experiments.scenario.loading import load_section
        from experiments.show.terminal.layout import print_paths

        settings = load_section(None, format_name, settings_class(format_name), overrides)
        print_paths(output, import_recording(format_name, folder, output, settings))

    return command
