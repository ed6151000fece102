"""Commands over many runs or many maps: sweeps, statistics, comparisons and studies."""

from pathlib import Path
from typing import Annotated

import typer

from experiments.cli import options
from experiments.cli.options import complete_setting
from mapfusion.errors import InputError

app = typer.Typer()
studies = typer.Typer(
    no_args_is_help=True, help="Measure methods: refusal, times, costs; and odometry."
)
app.add_typer(studies, name="study", rich_help_panel=options.LOOK)


@studies.command()
def refusal(
    worlds: Annotated[
        list[str],
        typer.Argument(
            metavar="WORLD...",
            help="Results of runs; or scenarios or tags, for each of --seeds (or full@0..9).",
        ),
    ],
    *,
    output: options.Output,
    pairs: Annotated[
        int, typer.Option(help="Pairs of maps of different seeds, of each kind.", min=1)
    ] = 200,
    every: Annotated[
        int, typer.Option(help="Interval between the iterations of a run that are used.", min=1)
    ] = 1,
    seeds: options.Seeds = "0",
    jobs: options.Jobs = options.ALL_CORES,
    results: options.Results = options.RESULTS,
) -> None:
    """Measure false merges and refusals on maps with and without common ground.

    Maps of different worlds have no common ground. For example, after a sweep of these worlds:
    `mapfusion study refusal full --seeds 0..2 -o refusal`.
    """
    from experiments.cli.options import require_folder
    from experiments.reports import layout, study_screen
    from experiments.reports.study_files import draw_refusals, write_kinds
    from experiments.scenario.suite import parse_seeds
    from experiments.studies import refusal_rates, refusal_trial
    from experiments.studies.refusal_trial import PairsDrawn, worlds_of

    require_folder(output, worlds)
    mapped, drawn = worlds_of(worlds, parse_seeds(seeds), results), PairsDrawn(pairs, every)
    with layout.progress() as show:
        false_alarms = refusal_trial.run(mapped, output, drawn, jobs, show)
    refusals, calibration = (refusal_trial.read(output, name) for name in refusal_trial.TABLES)
    study_screen.print_refusals(refusal_rates.summary(refusals), false_alarms)
    kinds = refusal_rates.by_kind(refusals)
    study_screen.print_kinds(kinds)
    pictures = draw_refusals(output, refusals, calibration, false_alarms)
    layout.print_paths(output, [write_kinds(output, refusals, kinds), *pictures])


@studies.command()
def verdicts(
    paths: Annotated[list[Path], typer.Argument(metavar="RESULT...", help="Results or sweeps.")],
    *,
    output: options.OutputFolder = None,
    alpha: Annotated[
        float, typer.Option(help="Largest share of runs with a false merge.", min=1e-6, max=0.5)
    ] = 0.02,
    delta: Annotated[
        float, typer.Option(help="One minus the confidence.", min=1e-9, max=0.5)
    ] = 0.05,
) -> None:
    """Bound the share of runs with a false merge, and certify a threshold of the verdict.

    Runs must be independent: other seeds, one setting. Runs with `--set
    align.evidence.least_ratio=1` can certify any threshold: `mapfusion study verdicts
    results/sweeps/calibration -o guarantee`.
    """
    from experiments.cli.options import require_folder
    from experiments.reports import layout, study_screen
    from experiments.reports.study_files import write_guarantee
    from experiments.studies.refusal_rates import guarantee
    from experiments.studies.run_tables import find_runs

    require_folder(output, paths)
    found = guarantee(find_runs(paths), alpha, delta)
    study_screen.print_guarantee(found)
    if output is not None:
        layout.print_paths(output, write_guarantee(output, found))


@app.command(rich_help_panel=options.RUN)
def sweep(
    scenarios: options.ScenarioNames,
    *,
    seeds: options.Seeds = "0",
    aligners: options.Aligners,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE,...",
            autocompletion=complete_setting,
            help="Values to try, e.g. slam.filter.n_particles=50,200; several give all "
            "combinations. Commas inside brackets do not separate values.",
        ),
    ] = None,
    jobs: options.Jobs = options.ALL_CORES,
    scheduler: Annotated[
        str | None,
        typer.Option(help="A running Dask scheduler, tcp://HOST:PORT, in place of --jobs."),
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER/COUNT",
            help="Only this part of the runs, 1/4 to 4/4 for four jobs that share RESULTS.",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder; RESULTS/sweeps/NAME by default.")
    ] = None,
    dry_run: options.DryRun = False,
    timings: Annotated[
        bool, typer.Option("--timings", help="At the end, time the aligners one after the other.")
    ] = False,
    results: options.Results = options.RESULTS,
) -> None:
    """Run all combinations: `mapfusion sweep scenarios/quick.yaml --seeds 0..9 --set KEY=A,B`.

    Finished stages are kept, also of an interrupted run, and the same command continues. With more
    seeds or values it adds to the same tables. Exit code 1 if a run failed.
    """
    from experiments.cli.options import require_folder
    from experiments.reports import layout, study_screen
    from experiments.scenario.suite import parse_seeds
    from experiments.studies import sweep

    require_folder(output, scenarios)
    chosen = parse_seeds(seeds), settings or (), results, output, aligners
    part = None if shard is None else sweep.Shard.parse(shard)
    asked = sweep.prepare(scenarios, *chosen, shard=part)
    if dry_run:
        study_screen.print_survey(sweep.survey(asked))
        return
    with layout.progress() as show:
        ended = sweep.execute(asked, jobs, scheduler, study_screen.shown_by(show))
        if timings:
            sweep.measure_times(asked, ended.failed, show)
    study_screen.print_sweep(asked.dataset, asked.runs, ended.failed)
    if ended.failed:
        raise typer.Exit(options.EXIT_DEFECT if ended.defects else options.EXIT_FAILED)


@app.command(rich_help_panel=options.LOOK)
def statistics(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="Results or sweeps.")],
    *,
    output: options.OutputFolder = None,
    as_json: options.AsJson = False,
) -> None:
    """Summarise success, errors and consistency of runs: `mapfusion statistics results/quick-*`."""
    from experiments.cli.options import require_folder
    from experiments.reports.statistics_screen import print_summary
    from experiments.reports.study_files import run_statistics

    require_folder(output, paths)
    summary, skipped = run_statistics(paths, output, as_json)
    if not as_json:
        print_summary(summary, output, skipped)


@app.command(rich_help_panel=options.LOOK)
def compare(
    first: Annotated[
        Path, typer.Argument(metavar="FIRST", help="Result or sweep of the first version.")
    ],
    second: Annotated[
        Path | None,
        typer.Argument(metavar="[SECOND]", help="Result or sweep of the second version."),
    ] = None,
    values: Annotated[
        str | None,
        typer.Option(
            "--values",
            metavar="KEY=A,B",
            help="Compare these values of a setting within the sweep FIRST, in place of SECOND.",
        ),
    ] = None,
    show_all: Annotated[bool, typer.Option("--all", help="Show unchanged values, too.")] = False,
    output: options.OutputFolder = None,
    apart_from: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY", help="Setting in which matched runs may differ; may be repeated."
        ),
    ] = None,
    fail_if_worse: Annotated[
        bool, typer.Option("--fail-if-worse", help="Exit code 1 if anything got worse.")
    ] = False,
) -> None:
    """Compare the results of two versions: `mapfusion compare old/quick-0 new/quick-0`.

    Or two values of a setting within one sweep: `mapfusion compare results/sweeps/quick
    --values slam.filter.n_particles=50,200`. Runs are matched by scenario, seed and settings.
    Values are called better or worse only if the difference exceeds the noise.
    """
    from experiments.cli.options import require_folder
    from experiments.reports.export import write_tables
    from experiments.reports.statistics_screen import print_comparison
    from experiments.studies import comparison
    from experiments.studies.sweep import parse_axes

    require_folder(output, [first, second])
    if (second is None) == (values is None):
        raise InputError("compare: give a second result or sweep, or --values KEY=A,B")
    if second is not None:
        found = comparison.compare(first, second, apart_from or ())
    else:
        axes = parse_axes([values or ""], "--values")
        ((setting, pair),) = axes.items()
        if len(pair) != 2:
            raise InputError(f"--values {values}: expected two values, {setting}=A,B")
        found = comparison.compare_values(first, setting, *pair)
    if output is not None:
        write_tables(output, {"comparison": found.table})
    print_comparison(found, show_all, output)
    if found.worse and fail_if_worse:
        raise typer.Exit(options.EXIT_FAILED)


@studies.command()
def benchmark(
    *,
    aligners: options.Aligners,
    trials: Annotated[int, typer.Option(help="Trials of each method in a cell.", min=1)] = 100,
    pairs: Annotated[
        list[int] | None, typer.Option(help="Numbers of pairs; may be repeated.", min=3)
    ] = None,
    outliers: Annotated[
        list[float] | None,
        typer.Option(help="Shares of false pairs; may be repeated.", min=0, max=1),
    ] = None,
    unpaired: Annotated[
        float, typer.Option(help="Share of landmarks without a partner.", min=0, max=0.99)
    ] = 0.0,
    seed: options.Seed = None,
    scenario: options.SettingsOf = None,
    budget_s: Annotated[
        float, typer.Option(help="Time limit of a cell; it keeps its finished trials.", min=0)
    ] = 600.0,
    output: options.OutputFolder = None,
    results: options.Results = options.RESULTS,
) -> None:
    """Measure success, error and time of all methods on random maps: `mapfusion study benchmark`.

    Trials run one after the other, so that times can be compared. Finished cells are reused.
    """
    from experiments.cli.options import require_folder
    from experiments.pipeline.store import Store
    from experiments.reports import layout, study_screen
    from experiments.reports.study_files import write_benchmark
    from experiments.scenario.suite import settings_of
    from experiments.studies import benchmark

    require_folder(output, [scenario])
    entries = benchmark.entries_of(aligners, scenario)
    counts, shares = (
        tuple(pairs or benchmark.PAIR_COUNTS),
        tuple(outliers or benchmark.OUTLIER_SHARES),
    )
    chosen_seed = settings_of(scenario, (), seed).seed
    design = benchmark.BenchmarkDesign(
        entries, trials, chosen_seed, budget_s, counts, shares, unpaired
    )
    folder = output or results / "benchmark"
    with layout.progress() as show:
        rows = benchmark.run_benchmark(design, Store(results / "store"), show)
    summary = benchmark.summarise(rows)
    write_benchmark(folder, design, rows, summary)
    study_screen.print_benchmark(folder, summary)


@studies.command()
def tasks(
    scenarios: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SCENARIO...]",
            help="Scenarios of the tasks, in place of the usual twelve.",
            autocompletion=options.complete_scenario,
        ),
    ] = None,
    *,
    output: options.Output,
    seeds: options.Seeds = "0..4",
    jobs: options.Jobs = options.ALL_CORES,
    results: options.Results = options.RESULTS,
) -> None:
    """Make the task set of the leaderboard: `mapfusion study tasks -o results/tasks`.

    Simulates the runs and writes maps, correspondences and, apart, the truth. Finished stages are
    reused. Other seeds give hidden tasks for a competition.
    """
    from experiments.cli.options import require_folder
    from experiments.pipeline.store import Store
    from experiments.reports import layout
    from experiments.scenario.suite import parse_seeds
    from experiments.studies import task_set

    chosen = tuple(scenarios or task_set.SCENARIOS)
    require_folder(output, chosen)
    store = Store.of(results)
    with layout.progress() as show:
        made = task_set.make_task_set(output, chosen, parse_seeds(seeds), store, jobs, show)
    layout.print_lines([f"{len(made.tasks)} tasks in {output}", f"SHA-256 {made.digest}"])


@studies.command()
def leaderboard(
    tasks: Annotated[
        Path, typer.Argument(metavar="TASKS", help="Folder that `mapfusion study tasks` wrote.")
    ],
    *,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            metavar="NAME",
            help="A further aligner, as FILE.py:CLASS; may be repeated.",
            autocompletion=options.complete_aligner,
        ),
    ] = None,
    only: Annotated[
        bool,
        typer.Option("--only", help="Rank the methods of --method alone, beside the reference."),
    ] = False,
    estimates: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE.csv",
            help="Motions computed elsewhere, with columns task, tx_m, ty_m, theta_rad; may be "
            "repeated.",
        ),
    ] = None,
    output: options.OutputFolder = None,
    results: options.Results = options.RESULTS,
) -> None:
    """Rank aligners and fusers on a task set: `mapfusion study leaderboard results/tasks`.

    Writes a page and tables. Methods run one after the other, so that times can be compared.
    Finished results are reused: `--method mine.py:Mine` then computes only its own.
    """
    from experiments.cli.options import require_folder
    from experiments.pipeline.store import Store
    from experiments.reports import layout
    from experiments.reports.report.leaderboard_page import print_leaderboard, write_leaderboard
    from experiments.studies.leaderboard import chosen_methods, run_leaderboard
    from experiments.studies.task_set import TaskSet

    folder = output or results / "leaderboard"
    require_folder(folder, [tasks, *(estimates or ())])
    aligners, fusers = chosen_methods(methods or (), only)
    found = TaskSet.read(tasks)
    store = Store.of(results)
    with layout.progress() as show:
        board = run_leaderboard(found, aligners, fusers, estimates or (), store, show)
    write_leaderboard(board, folder)
    print_leaderboard(board, folder)


@studies.command()
def paper(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="PATH...", help="Results or sweeps of paper and paper_as_printed, ten seeds."
        ),
    ],
    *,
    trials: Annotated[
        int, typer.Option(help="Trials of each method at each share of false pairs.", min=1)
    ] = 100,
    output: options.OutputFolder = None,
    results: options.Results = options.RESULTS,
) -> None:
    """Compare the claims of the paper with runs: `mapfusion study paper results/paper*`.

    Writes a page with one row per claim: measure, value with interval over the runs, and verdict.
    Makes trials with known shares of false pairs too; finished trials are reused.
    """
    from experiments.cli.options import require_folder
    from experiments.pipeline.store import Store
    from experiments.reports import layout, study_screen
    from experiments.reports.study_files import write_claims
    from experiments.studies import paper_claims
    from experiments.studies.benchmark import crossing_designs, crossing_rows, run_benchmark
    from experiments.studies.run_tables import find_runs
    from mapfusion.errors import InputError

    require_folder(output, paths)
    values = paper_claims.compare_with_paper([find_runs(path) for path in paths])
    if values.empty:
        wanted = " or ".join(paper_claims.SCENARIOS)
        raise InputError(f"{', '.join(map(str, paths))}: no run of the scenario {wanted}")
    folder = output or results / "study-paper"
    require_folder(folder)
    with layout.progress() as show:
        trials_of = {
            design.unpaired_share: run_benchmark(design, Store(results / "store"), show)
            for design in crossing_designs(paper_claims.ALIGNERS, trials)
        }
    study_screen.print_claims(values)
    crossing = crossing_rows(trials_of)
    layout.print_paths(folder, write_claims(folder, values, crossing))


@studies.command()
def independence(
    scenario: options.OneScenario,
    *,
    seeds: options.Seeds = "0",
    robots: Annotated[
        str | None,
        typer.Option(
            metavar="N,...",
            help="Sizes of teams, e.g. 3,5: the first N robots of the scenario; all by default.",
        ),
    ] = None,
    overrides: options.Overrides,
    output: options.OutputFolder = None,
    jobs: options.Jobs = options.ALL_CORES,
    results: options.Results = options.RESULTS,
) -> None:
    """Compare independent mapping with fusion to a joint smoother of all logs.

    Measures time, memory, bytes and errors. For example: `mapfusion study independence paper
    --seeds 0..2`. Measurements run one after the other. Finished measurements are reused.
    """
    from experiments.cli.options import require_folder
    from experiments.pipeline.store import Store
    from experiments.reports import layout, study_screen
    from experiments.reports.study_files import write_independence
    from experiments.scenario.loading import load_scenario
    from experiments.scenario.suite import one_scenario, parse_seeds
    from experiments.studies import independence_trial

    require_folder(output, [scenario])
    path = one_scenario(scenario)
    loaded = [load_scenario(path, overrides, seed) for seed in parse_seeds(seeds)]
    sizes = independence_trial.team_sizes(robots, loaded[0])
    folder = output or results / f"independence-{loaded[0].name}"
    require_folder(folder)  # before measurements that take hours
    with layout.progress() as show:
        store = Store.of(results)
        found = independence_trial.run_independence(loaded, sizes, store, jobs, show)
        skipped = write_independence(folder, loaded, found)
    study_screen.print_independence(
        folder, independence_trial.medians_at_last_iteration(found), skipped
    )


@studies.command()
def calibrate(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Robot logs (folders).")],
    *,
    output: options.OutputFolder = None,
    scenario: options.SettingsOf = None,
    overrides: options.Overrides,
    seed: options.Seed = None,
    as_json: options.AsJson = False,
) -> None:
    """Calibrate and correct odometry of logs: `mapfusion study calibrate raw/robot* -o logs`."""
    from experiments.cli.options import require_folder
    from experiments.evaluation.single_steps import calibrate_logs
    from experiments.reports import export, layout, study_screen
    from experiments.scenario.suite import settings_of

    require_folder(output, [*logs, scenario], may_hold=True)
    options.announce_compilation(as_json)
    settings = settings_of(scenario, overrides, seed)
    with layout.progress() as show:
        found = calibrate_logs(logs, output, settings, show)
    written = [] if output is None else [output / each.robot for each in found.robots]
    made = study_screen.document(found, written)
    export.publish_json("calibrate", made, as_json)
    if not as_json:
        study_screen.print_calibration(found, written)


@studies.command()
def team(
    graphs: Annotated[
        list[Path],
        typer.Argument(metavar="GRAPH...", help="Pose graphs (.g2o), or a folder of the robots'."),
    ],
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="CSV file: motions between robots.")
    ] = None,
    stated_noise: Annotated[
        bool,
        typer.Option(
            "--stated-noise",
            help="Take the noise as stated; by default the robots' own loops tell it.",
        ),
    ] = False,
    as_json: options.AsJson = False,
) -> None:
    """Judge motions between robots in pose graphs: `mapfusion study team FOLDER`.

    Motions that contradict the others are refused. Exit code 1 if no two robots are connected. See
    `mapfusion docs export`.
    """
    from experiments.reports import export
    from experiments.reports.team_screen import (
        motions_frame,
        print_team,
        read_graph_files,
        team_document,
    )
    from mapfusion.fusion.team_pose_graph import judge_pose_graph

    if output is not None and output.suffix != ".csv":
        raise InputError(f"-o {output}: ends in {output.suffix or 'nothing'}, expected .csv")
    graph = read_graph_files(graphs)
    try:
        judged = judge_pose_graph(graph, estimate_noise=not stated_noise)
    except ValueError as error:
        raise InputError(f"{graphs[0]}: {error}") from error
    if output is not None:
        export.write_text(output, motions_frame(judged).to_csv(index=False))
    export.publish_json("team", team_document(judged), as_json)
    if not as_json:
        print_team(judged)
    if judged.component.max() + 1 == len(judged.robots):
        options.print_to_stderr("no two robots are connected")
        raise typer.Exit(options.EXIT_FAILED)
