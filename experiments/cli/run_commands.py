"""Commands that run scenarios and show their results."""

from pathlib import Path
from typing import Annotated

import typer

from experiments.cli.options import (
    DEFAULT_RESULTS,
    EXIT_FAILED,
    Fresh,
    Jobs,
    Overrides,
    Results,
    ScenarioNames,
    Seed,
    available_cores,
)


def run(
    scenarios: ScenarioNames,
    seed: Seed = None,
    overrides: Overrides = None,
    jobs: Jobs = None,
    fresh: Fresh = False,
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Simulate, map, align, merge, evaluate and draw: `mapfusion run scenarios/quick.yaml`.

    Finished stages are reused; an interrupted run goes on where it was.
    """
    from experiments.judge.expectations import load_checked
    from experiments.judge.result import result_folder, run_scenario
    from experiments.scenario.suite import scenarios_of
    from experiments.show.figures import draw_all
    from experiments.show.terminal.layout import progress
    from experiments.show.terminal.run_screen import print_result

    n_jobs = jobs or available_cores()
    for loaded in [load_checked(s, overrides or (), seed) for s in scenarios_of(scenarios)]:
        folder = result_folder(results, loaded)
        skipped: list[str] = []
        with progress() as show:
            run_scenario(loaded, results, n_jobs, show, fresh)
            draw_all(
                folder,
                n_jobs,
                lambda done, total, show=show: show("figures", done, total),
                skipped.append,
            )
        print_result(folder, skipped)


def figures(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="A run's result folder.")],
    jobs: Jobs = None,
) -> None:
    """Draw a result's figures again, from its tables alone: `mapfusion figures results/quick-0`."""
    from experiments.judge.result import require_result
    from experiments.show.figures import draw_all
    from experiments.show.terminal.layout import print_paths, progress

    require_result(result)
    skipped: list[str] = []
    with progress() as show:
        paths = draw_all(
            result,
            jobs or available_cores(),
            lambda done, total: show("figures", done, total),
            skipped.append,
        )
    print_paths(result / "figures", paths, skipped)


def report(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="A run's result folder.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="HTML file; RESULT/report.html by default."),
    ] = None,
) -> None:
    """Show a result in one HTML file that works offline: `mapfusion report results/quick-0`."""
    from experiments.show.report import write_report
    from experiments.show.terminal.layout import print_file

    print_file(write_report(result, output))


def inspect_command(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="A file or folder of mapfusion's.")],
) -> None:
    """Tell what a file or folder of mapfusion's holds: `mapfusion inspect R1.parquet`."""
    from experiments.show.inspect import inspect

    inspect(path)


def check(
    scenarios: ScenarioNames,
    seeds: Annotated[str, typer.Option(help="A seed, a range 0..4 or a list 0,2,5.")] = "0",
    overrides: Overrides = None,
    jobs: Jobs = None,
    fresh: Fresh = False,
    junit: Annotated[Path | None, typer.Option(help="Write a JUnit report to this file.")] = None,
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Hold runs to their `expect` blocks, exit code 1 if one fails: `mapfusion check ci`."""
    from experiments.judge.expectations import check as check_scenario
    from experiments.judge.expectations import load_checked, parse_seeds, write_junit
    from experiments.judge.result import run_scenario
    from experiments.scenario.suite import scenarios_of
    from experiments.show.terminal.layout import progress
    from experiments.show.terminal.run_screen import print_outcomes

    wanted = parse_seeds(seeds)
    paths = scenarios_of(scenarios)
    loaded = [[load_checked(path, overrides or (), seed) for seed in wanted] for path in paths]
    outcomes = []
    for per_seed in loaded:
        folders = {}
        with progress() as show:
            for entry in per_seed:
                folders[entry.seed] = run_scenario(
                    entry, results, jobs or available_cores(), show, fresh
                )
        outcomes += check_scenario(per_seed[0], folders)
    print_outcomes(outcomes)
    if junit is not None:
        write_junit(junit, outcomes)
    if not all(outcome.passed for outcome in outcomes):
        raise typer.Exit(EXIT_FAILED)


def list_scenarios(
    folder: Annotated[Path, typer.Argument(metavar="[FOLDER]", help="Of scenario files.")] = Path(
        "scenarios"
    ),
) -> None:
    """List the suite, with the tags that `run` and `check` take: `mapfusion scenarios`."""
    from experiments.scenario.suite import entries
    from experiments.show.terminal.study_screen import print_scenarios

    print_scenarios(entries(folder))


def schema() -> None:
    """Print the JSON schema of scenarios, for editors: `mapfusion schema > schema.json`."""
    from experiments.scenario.settings import schema_text

    typer.echo(schema_text())
