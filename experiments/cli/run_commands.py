"""Commands that run scenarios and show their results."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from experiments.cli import options

app = typer.Typer()
_DRAWING = "draw the figures"


@app.command()
def run(
    scenarios: options.ScenarioNames,
    *,
    seed: options.Seed = None,
    overrides: options.Overrides,
    jobs: options.Jobs = options.ALL_CORES,
    fresh: options.Fresh = False,
    results: options.Results = options.RESULTS,
) -> None:
    """Simulate, map, align, merge, evaluate and draw: `mapfusion run scenarios/quick.yaml`.

    Finished stages are reused; an interrupted run goes on where it was.
    """
    from experiments.judge.expectations import load_checked
    from experiments.scenario.suite import scenarios_of

    checked = [load_checked(path, overrides, seed) for path in scenarios_of(scenarios)]
    # What draws takes seconds to import: a scenario is refused before.
    from experiments.judge.result import run_scenario
    from experiments.show.figures.drawing import draw_all
    from experiments.show.terminal import layout, run_screen

    for loaded in checked:
        with layout.progress() as show:
            folder = run_scenario(loaded, results, jobs, show, fresh)
            drawn = draw_all(folder, jobs, partial(show, _DRAWING))
        run_screen.print_result(folder, drawn.skipped)


@app.command()
def figures(result: options.ResultFolder, *, jobs: options.Jobs = options.ALL_CORES) -> None:
    """Draw a result's figures again, from its tables alone: `mapfusion figures results/quick-0`."""
    from experiments.judge.result import require_result
    from experiments.show.figures.drawing import draw_all
    from experiments.show.terminal import layout

    require_result(result)
    with layout.progress() as show:
        drawn = draw_all(result, jobs, partial(show, _DRAWING))
    layout.print_paths(result / "figures", *drawn)


@app.command()
def report(
    result: options.ResultFolder,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="HTML file; RESULT/report.html by default."),
    ] = None,
) -> None:
    """Show a result in one HTML file that works offline: `mapfusion report results/quick-0`."""
    from experiments.show.report.document import write_report
    from experiments.show.terminal.layout import print_lines

    path = write_report(result, output)
    print_lines([f"{path} ({path.stat().st_size / 1e6:.1f} MB)"])


@app.command("inspect")
def inspect_command(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="A file or folder of mapfusion's.")],
) -> None:
    """Tell what a file or folder of mapfusion's holds: `mapfusion inspect R1.parquet`."""
    from experiments.show.inspect import inspect

    inspect(path)


@app.command()
def check(
    scenarios: options.ScenarioNames,
    *,
    seeds: options.Seeds = "0",
    overrides: options.Overrides,
    jobs: options.Jobs = options.ALL_CORES,
    fresh: options.Fresh = False,
    junit: Annotated[Path | None, typer.Option(help="Write a JUnit report to this file.")] = None,
    results: options.Results = options.RESULTS,
) -> None:
    """Hold runs to their `expect` blocks, exit code 1 if one fails: `mapfusion check ci`."""
    from experiments.judge import expectations
    from experiments.scenario.seeds import parse_seeds
    from experiments.scenario.suite import scenarios_of

    wanted = parse_seeds(seeds)
    checked = [
        [expectations.load_checked(path, overrides, seed) for seed in wanted]
        for path in scenarios_of(scenarios)
    ]
    from experiments.judge.result import run_scenario  # as in `run`
    from experiments.show.junit import write_junit
    from experiments.show.terminal import layout, run_screen

    outcomes = []
    for runs in checked:
        with layout.progress() as show:
            folders = {run.seed: run_scenario(run, results, jobs, show, fresh) for run in runs}
        outcomes += expectations.check(runs[0], folders)
    run_screen.print_outcomes(outcomes)
    if junit is not None:
        write_junit(junit, outcomes)
    if not all(outcome.passed for outcome in outcomes):
        raise typer.Exit(options.EXIT_FAILED)


@app.command("scenarios")
def list_scenarios(
    folder: Annotated[
        Path | None, typer.Argument(help="Of scenario files; the suite's by default.")
    ] = None,
    *,
    copy: Annotated[
        str | None, typer.Option(metavar="NAME", help="Write scenarios/NAME.yaml instead, to edit.")
    ] = None,
) -> None:
    """List the suite, with the tags that `run` and `check` take: `mapfusion scenarios`."""
    from experiments.scenario.suite import copy_to_edit, entries

    if copy is not None:
        typer.echo(copy_to_edit(copy))
        return
    from experiments.show.terminal.study_screen import print_scenarios

    print_scenarios(entries(folder))


@app.command()
def schema() -> None:
    """Print the JSON schema of scenarios, for editors: `mapfusion schema > schema.json`."""
    from experiments.scenario.schema import schema_text

    typer.echo(schema_text(), nl=False)
