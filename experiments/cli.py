"""The command `mapfusion`: load, compute, show. Heavy imports sit inside the commands."""

import os
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Measures how well landmark maps of independent robots can be fused.\n\n"
    "Start with:  mapfusion run scenarios/quick.yaml",
)
import_app = typer.Typer(no_args_is_help=True, help="Turn recordings of others into robot logs.")
app.add_typer(import_app, name="import")

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
DEFAULT_RESULTS = Path("results")


@app.command()
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
    from experiments import screen
    from experiments.figures import draw_all
    from experiments.result import result_folder, run_scenario
    from experiments.scenario import load_scenario
    from experiments.suite import scenarios_of

    n_jobs = jobs or available_cores()
    for loaded in [load_scenario(s, overrides or (), seed) for s in scenarios_of(scenarios)]:
        folder = result_folder(results, loaded)
        skipped: list[str] = []
        with screen.progress() as show:
            run_scenario(loaded, results, n_jobs, show, fresh)
            draw_all(
                folder,
                n_jobs,
                lambda done, total, show=show: show("figures", done, total),
                skipped.append,
            )
        screen.print_result(folder, skipped)


@app.command()
def figures(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="A run's result folder.")],
    jobs: Jobs = None,
) -> None:
    """Draw a result's figures again, from its tables alone: `mapfusion figures results/quick-0`."""
    from experiments import screen
    from experiments.figures import draw_all
    from experiments.result import require_result

    require_result(result)
    skipped: list[str] = []
    with screen.progress() as show:
        paths = draw_all(
            result,
            jobs or available_cores(),
            lambda done, total: show("figures", done, total),
            skipped.append,
        )
    screen.print_paths(result / "figures", paths, skipped)


@app.command()
def report(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="A run's result folder.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="HTML file; RESULT/report.html by default."),
    ] = None,
) -> None:
    """Show a result in one HTML file that works offline: `mapfusion report results/quick-0`."""
    from experiments import screen
    from experiments.report import write_report

    screen.print_file(write_report(result, output))


@app.command("inspect")
def inspect_command(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="A file or folder of mapfusion's.")],
) -> None:
    """Tell what a file or folder of mapfusion's holds: `mapfusion inspect R1.parquet`."""
    from experiments.inspection.command import inspect

    inspect(path)


@app.command()
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
    from experiments import screen
    from experiments.checks import check as check_scenario
    from experiments.checks import parse_seeds, write_junit
    from experiments.result import run_scenario
    from experiments.scenario import load_scenario
    from experiments.suite import scenarios_of

    wanted = parse_seeds(seeds)
    paths = scenarios_of(scenarios)
    loaded = [[load_scenario(path, overrides or (), seed) for seed in wanted] for path in paths]
    outcomes = []
    for per_seed in loaded:
        folders = {}
        with screen.progress() as show:
            for entry in per_seed:
                folders[entry.seed] = run_scenario(
                    entry, results, jobs or available_cores(), show, fresh
                )
        outcomes += check_scenario(per_seed[0], folders)
    screen.print_outcomes(outcomes)
    if junit is not None:
        write_junit(junit, outcomes)
    if not all(outcome.passed for outcome in outcomes):
        raise typer.Exit(EXIT_FAILED)


@app.command("scenarios")
def list_scenarios(
    folder: Annotated[Path, typer.Argument(metavar="[FOLDER]", help="Of scenario files.")] = Path(
        "scenarios"
    ),
) -> None:
    """List the suite, with the tags that `run` and `check` take: `mapfusion scenarios`."""
    from experiments import screen
    from experiments.suite import entries

    screen.print_scenarios(entries(folder))


@app.command()
def refusal(
    results: Annotated[
        list[Path], typer.Argument(metavar="RESULT RESULT...", help="Results of different worlds.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for tables and figure.")],
    pairs: Annotated[int, typer.Option(help="Pairs of maps without common ground.", min=1)] = 500,
    jobs: Jobs = None,
) -> None:
    """Cross the maps of several worlds: are those without common ground refused, and only those?

    For example: `mapfusion refusal results/quick-0 results/quick-1 -o results/refusal`.
    """
    from experiments import screen
    from experiments.figures.refusal import write
    from experiments.refusal.results import read
    from experiments.refusal.summary import summary
    from experiments.refusal.trial import run

    with screen.progress() as show:
        acceptance = run(results, output, pairs, jobs or available_cores(), show)
    refusals, calibration = read(output, "refusals"), read(output, "calibration")
    pictures = write(output, refusals, calibration, acceptance.false_alarms)
    screen.print_refusals(summary(refusals), acceptance.false_alarms)
    screen.print_paths(output, pictures)


@app.command()
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
    from experiments.checks import parse_seeds
    from experiments.suite import scenarios_of
    from experiments.sweep import command, screen

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


@app.command()
def statistics(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="Results or sweeps.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for all tables and figures.")
    ] = None,
) -> None:
    """Success, errors and consistency over many runs: `mapfusion statistics results/quick-*`."""
    from experiments.statistics.command import run_statistics

    run_statistics(paths, output)


@app.command()
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
    from experiments.statistics.command import run_compare

    if run_compare(first, second, show_all, output) and fail_if_worse:
        raise typer.Exit(EXIT_FAILED)


@app.command()
def schema() -> None:
    """Print the JSON schema of scenarios, for editors: `mapfusion schema > schema.json`."""
    from experiments.scenario import schema_text

    typer.echo(schema_text())


@app.command()
def record(
    scenario: ScenarioPath,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
    seed: Seed = None,
    overrides: Overrides = None,
    jobs: Jobs = None,
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Simulate only: one robot log (with its truth) per robot: `mapfusion record S -o logs`."""
    from experiments import screen, single
    from experiments.scenario import load_scenario

    loaded = load_scenario(scenario, overrides or (), seed)
    with screen.progress() as show:
        paths = single.record(loaded, output, results, jobs or available_cores(), show)
    screen.print_paths(output, paths)


@app.command()
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
    from experiments import screen, single

    slam_settings = single.slam_settings(settings, overrides or ())
    with screen.progress() as show:
        landmarks = single.slam(log, slam_settings, seed, show)
    single.save_map(output, landmarks)
    screen.print_map(output, landmarks)


@app.command()
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
    from experiments import screen, single

    rows = single.align(map_a, map_b, single.align_settings(settings, overrides or ()), seed)
    screen.print_estimates(rows)


@app.command()
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
    from experiments import screen, single

    fused, joined = single.merge(maps, settings, overrides or (), seed)
    single.save_map(output, fused.landmarks)
    screen.print_fused(output, fused, joined)


@app.command()
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
    from experiments import benchmark as measure
    from experiments import screen
    from experiments.benchmark_report import write_benchmark
    from experiments.store import Store

    plan = measure.Plan(
        measure.entries_of(methods or (), settings),
        trials,
        seed,
        budget_s,
        tuple(pairs or measure.PAIR_COUNTS),
        tuple(outliers or measure.OUTLIER_SHARES),
    )
    folder = output or results / "benchmark"
    with screen.progress() as show:
        rows = measure.run_benchmark(
            plan, Store(results / "store"), lambda done, total: show("benchmark", done, total)
        )
    summary = measure.summarise(rows)
    write_benchmark(folder, plan, rows, summary)
    screen.print_benchmark(folder, summary)


@app.command()
def aligners() -> None:
    """List the alignment methods that scenarios can name, and whose they are."""
    from experiments import screen

    screen.print_methods()


@import_app.command("mrclam")
def import_mrclam_command(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="An MRCLAM recording.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the logs.")],
) -> None:
    """UTIAS MRCLAM recordings: `mapfusion import mrclam MRCLAM_Dataset7 -o logs/mrclam7`."""
    from experiments import screen
    from experiments.mrclam import import_mrclam

    screen.print_paths(output, import_mrclam(folder, output))


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def main() -> None:
    """Run the command; every failure a user can cause is one line and an exit code."""
    from experiments.kernel_cache import use_kernel_cache
    from mapfusion.errors import InputError

    _tell_name_clashes()
    try:
        use_kernel_cache()
        code = app(standalone_mode=False) or 0
    except InputError as error:
        _complain(str(error))
        code = EXIT_BAD_INPUT
    except BrokenPipeError:
        code = EXIT_FAILED
    except OSError as error:  # a full disk, a folder that is a file or not ours
        where = "" if error.filename is None else f"{error.filename}: "
        _complain(f"{where}cannot be read or written ({error.strerror or error})")
        code = EXIT_BAD_INPUT
    except KeyboardInterrupt:  # before or after what the command itself guards
        code = EXIT_INTERRUPTED
    except Exception as error:
        # Typer keeps its usage errors' classes private; all of them can tell their message.
        message = getattr(error, "format_message", None)
        if message is None:
            raise
        if message():  # empty where the help was shown instead
            _complain(f"{message()} (see mapfusion --help)")
        code = EXIT_BAD_INPUT
    if code == EXIT_INTERRUPTED:
        _complain("interrupted; what was finished is kept, the same command goes on from there")
    sys.exit(code)


def _tell_name_clashes() -> None:
    """In one line each; other warnings keep Python's own form."""
    from mapfusion.errors import NameClashWarning

    show = warnings.showwarning

    def tell(message: Warning | str, category: type[Warning], *rest: Any) -> None:
        if issubclass(category, NameClashWarning):
            _complain(f"warning: {message}")
        else:
            show(message, category, *rest)

    warnings.showwarning = tell


def _complain(text: str) -> None:
    typer.echo(f"mapfusion: {' '.join(text.split())}", err=True)  # one line, whatever was quoted


if __name__ == "__main__":
    main()
