"""Commands over many runs or many maps: sweeps, statistics, refusal, the benchmark."""

from pathlib import Path
from typing import Annotated

import typer

from experiments.cli.options import (
    DEFAULT_RESULTS,
    EXIT_FAILED,
    Jobs,
    Results,
    available_cores,
)


def refusal(
    worlds: Annotated[
        list[str],
        typer.Argument(
            metavar="WORLD...", help="Results of runs; or scenarios or tags, for each of --seeds."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for tables and figure.")],
    pairs: Annotated[int, typer.Option(help="Pairs of maps without common ground.", min=1)] = 500,
    seeds: Annotated[str, typer.Option(help="Of the scenarios: a seed, 0..4 or 0,2,5.")] = "0",
    jobs: Jobs = None,
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Cross the maps of several worlds: are those without common ground refused, and only those?

    For example, after a sweep of them: `mapfusion refusal full --seeds 0..2 -o results/refusal`.
    """
    from experiments.judge.expectations import parse_seeds
    from experiments.show.figures.refusal_figures import write
    from experiments.show.terminal.layout import print_paths, progress
    from experiments.show.terminal.study_screen import print_refusals
    from experiments.study.refusal.refusal_rates import summary
    from experiments.study.refusal.refusal_tables import read
    from experiments.study.refusal.refusal_trial import run
    from experiments.study.refusal.stored_worlds import sources_of

    sources = sources_of(worlds, parse_seeds(seeds), results)
    with progress() as show:
        acceptance = run(sources, output, pairs, jobs or available_cores(), show)
    refusals, calibration = read(output, "refusals"), read(output, "calibration")
    pictures = write(output, refusals, calibration, acceptance.false_alarms)
    print_refusals(summary(refusals), acceptance.false_alarms)
    print_paths(output, pictures)


def sweep(
    scenarios: Annotated[
        list[str], typer.Argument(metavar="SCENARIO|TAG...", help="Scenario files, or tags.")
    ],
    seeds: Annotated[str, typer.Option(help="A seed, a range 0..4 or a list 0,2,5.")] = "0",
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE,...",
            help="Values to try, e.g. slam.filter.n_particles=50,200; several give all "
            "combinations. Commas inside brackets part nothing.",
        ),
    ] = None,
    jobs: Jobs = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="A running Dask scheduler, tcp://HOST:PORT, in place of --jobs."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder; RESULTS/sweeps/NAME by default.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only count what is to do.")] = False,
    timings: Annotated[
        bool, typer.Option("--timings", help="At the end, time the aligners one after the other.")
    ] = False,
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Run all combinations: `mapfusion sweep scenarios/quick.yaml --seeds 0..9 --set KEY=A,B`.

    What is finished is kept, also in the middle of a run; the same command goes on from there, and
    with more seeds or values adds to the same tables. Exit code 1 if a run failed.
    """
    from experiments.judge.expectations import parse_seeds
    from experiments.scenario.suite import scenarios_of
    from experiments.show.terminal import sweep_screen as screen
    from experiments.study.sweep import execution as command

    paths = scenarios_of(scenarios)
    asked = command.prepare(scenarios, paths, parse_seeds(seeds), overrides or (), results, output)
    if dry_run:
        screen.print_survey(command.look_ahead(asked))
        return
    with screen.progress() as show:
        failed = command.execute(asked, jobs or available_cores(), scheduler, show)
    if timings:
        with screen.timing_progress() as show_timing:
            command.measure_times(asked, failed, show_timing)
    screen.print_sweep(asked.dataset, asked.runs, failed)
    if failed:
        raise typer.Exit(EXIT_FAILED)


def statistics(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="Results or sweeps.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for all tables and figures.")
    ] = None,
) -> None:
    """Success, errors and consistency over many runs: `mapfusion statistics results/quick-*`."""
    from experiments.show.statistics_files import run_statistics

    run_statistics(paths, output)


def compare(
    first: Annotated[Path, typer.Argument(metavar="FIRST", help="Result or sweep of the one.")],
    second: Annotated[Path, typer.Argument(metavar="SECOND", help="And of the other version.")],
    show_all: Annotated[bool, typer.Option("--all", help="Show also what did not change.")] = False,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for the table.")
    ] = None,
    fail_if_worse: Annotated[
        bool, typer.Option("--fail-if-worse", help="Exit code 1 if anything got worse.")
    ] = False,
) -> None:
    """What got better or worse between two versions: `mapfusion compare old/quick-0 new/quick-0`.

    Runs are matched by scenario, seed and settings; a verdict means more than noise.
    """
    from experiments.show.statistics_files import run_compare

    if run_compare(first, second, show_all, output) and fail_if_worse:
        raise typer.Exit(EXIT_FAILED)


def benchmark(
    methods: Annotated[
        list[str] | None,
        typer.Option("--method", metavar="NAME", help="Only this method; may be repeated."),
    ] = None,
    trials: Annotated[int, typer.Option(help="Of each method in each cell.", min=1)] = 100,
    pairs: Annotated[
        list[int] | None, typer.Option(help="Numbers of pairs; may be repeated.", min=3)
    ] = None,
    outliers: Annotated[
        list[float] | None,
        typer.Option(help="Shares of false pairs; may be repeated.", min=0, max=1),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of maps and methods.", min=0)] = 0,
    settings: Annotated[
        Path | None, typer.Option("--scenario", help="Scenario whose `align.aligners` to measure.")
    ] = None,
    budget_s: Annotated[
        float, typer.Option(help="A cell that took longer ends with the trials it has.", min=0)
    ] = 600.0,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder to write.")] = None,
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Success, error and time of all methods on made-up maps: `mapfusion benchmark`.

    Serial, so that times can be compared; finished cells are reused.
    """
    from experiments.run.store import Store
    from experiments.show.benchmark_files import write_benchmark
    from experiments.show.terminal.layout import progress
    from experiments.show.terminal.study_screen import print_benchmark
    from experiments.study.benchmark import trials as measure

    plan = measure.Plan(
        measure.entries_of(methods or (), settings),
        trials,
        seed,
        budget_s,
        tuple(pairs or measure.PAIR_COUNTS),
        tuple(outliers or measure.OUTLIER_SHARES),
    )
    folder = output or results / "benchmark"
    with progress() as show:
        rows = measure.run_benchmark(
            plan, Store(results / "store"), lambda done, total: show("benchmark", done, total)
        )
    summary = measure.summarise(rows)
    write_benchmark(folder, plan, rows, summary)
    print_benchmark(folder, summary)


def aligners() -> None:
    """List the alignment methods that scenarios can name, and whose they are."""
    from experiments.show.terminal.study_screen import print_methods

    print_methods()
