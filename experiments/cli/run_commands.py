"""Commands that run scenarios and show their results."""

import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from experiments.cli import options
from experiments.cli.options import complete_scenario
from mapfusion.errors import InputError

app = typer.Typer()
_DRAWING = "draw the figures"


@app.command(rich_help_panel=options.RUN)
def run(
    scenarios: options.ScenarioNames,
    *,
    seed: options.Seed = None,
    aligners: options.Aligners,
    overrides: options.Overrides,
    jobs: options.Jobs = options.ALL_CORES,
    fresh: options.Fresh = False,
    no_figures: Annotated[
        bool, typer.Option("--no-figures", help="Draw no figures, which saves time.")
    ] = False,
    dry_run: options.DryRun = False,
    results: options.Results = options.RESULTS,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder; RESULTS/NAME-SEED by default."),
    ] = None,
) -> None:
    """Simulate, map, align, merge, evaluate and draw: `mapfusion run quick`.

    Finished stages are reused, so an interrupted run continues. The last two lines name the method
    to use, and the command that opens the report. Exit code 1 if no robot's map can be used.
    """
    from experiments.cli.options import require_result_folder
    from experiments.evaluation.metrics import load_checked
    from experiments.scenario.suite import scenarios_of, with_aligners

    require_result_folder(output)
    checked = [
        load_checked(path, with_aligners(path, overrides, aligners), seed)
        for path in scenarios_of(scenarios)
    ]
    if output is not None and len(checked) > 1:
        several = f"is one folder for {len(checked)} runs; give --results"
        raise InputError(f"--output {output}: {several}")
    if dry_run:
        from experiments.evaluation.run_plan import plan_run
        from experiments.reports.run_screen import print_plan

        for loaded in checked:
            print_plan(plan_run(loaded, results, jobs, fresh), results, jobs)
        return
    # The imports for drawing are slow: wrong scenarios are refused before.
    from experiments.evaluation.alignment_criteria import nothing_merged
    from experiments.evaluation.evaluated_run import finding_lines, has_usable_map
    from experiments.evaluation.result import add_times, run_scenario
    from experiments.pipeline.workers import workers
    from experiments.reports import layout, run_screen
    from experiments.reports.figures.drawing import Drawing, remove_figures

    unusable = False
    start = {"start": {"run": time.process_time()}}  # shared by all scenarios
    for loaded in checked:
        times, skipped = dict(start), None
        with layout.progress() as show, workers(jobs) as pool:
            if no_figures:
                folder = run_scenario(loaded, results, jobs, show, fresh, output)
                remove_figures(folder)  # those of an earlier run do not belong to these tables
            else:
                drawing = Drawing(pool)
                folder = run_scenario(loaded, results, jobs, show, fresh, output, drawing.written)
                drawn = drawing.finish(folder, partial(show, _DRAWING))
                times, skipped = times | {"figures": drawn.elapsed_s}, drawn.skipped
        add_times(folder, times)
        run_screen.print_result(folder, skipped)
        for line in finding_lines(folder):
            options.print_to_stderr(f"warning: {line}")
        if nothing := nothing_merged(folder):
            options.print_to_stderr(f"warning: {nothing.text}")
        if not has_usable_map(folder):
            options.print_to_stderr(
                f"{folder}: no robot's map can be used: all are empty or contradicted"
            )
            unusable = True
        layout.print_lines(run_screen.closing_lines(folder))
    if unusable:
        raise typer.Exit(options.EXIT_FAILED)


@app.command(rich_help_panel=options.LOOK)
def report(
    result: options.ResultFolder,
    *,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="HTML file; RESULT/report.html by default."),
    ] = None,
    figures: Annotated[
        bool, typer.Option("--figures", help="Draw RESULT/figures again first, from its tables.")
    ] = False,
    open_it: Annotated[
        bool, typer.Option("--open", help="Open the file in the browser, too.")
    ] = False,
    jobs: options.Jobs = options.ALL_CORES,
) -> None:
    """Show a result in one HTML file that works offline: `mapfusion report results/quick-0`."""
    from experiments.cli.options import REPORT, require_file
    from experiments.evaluation.result import require_result
    from experiments.reports import layout
    from experiments.reports.figures.drawing import draw_all
    from experiments.reports.report.document import write_report

    require_file("--output", output, REPORT)
    if figures:
        require_result(result)
        with layout.progress() as show:
            drawn = draw_all(result, jobs, partial(show, _DRAWING))
        layout.print_paths(result / "figures", drawn.files, drawn.skipped)
    path = write_report(result, output)
    layout.print_lines([f"{path} ({path.stat().st_size / 1e6:.1f} MB)"])
    if open_it:
        import webbrowser

        if not webbrowser.open(path.resolve().as_uri()):
            options.print_to_stderr(f"warning: no browser was found; open {path} in one")


@app.command(rich_help_panel=options.LOOK)
def export(
    result: options.ResultFolder,
    *,
    kind: options.Format,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder; RESULT/export by default.")
    ] = None,
) -> None:
    """Write a result in other programs' formats: `mapfusion export results/quick-0 --format tum`.

    `mapfusion docs export` describes files, frames and keys.
    """
    from experiments.cli.options import require_folder
    from experiments.reports.layout import print_lines
    from experiments.reports.result_export import export_result

    require_folder(output, [result])
    print_lines(map(str, export_result(result, kind, output)))


@app.command("inspect", rich_help_panel=options.LOOK)
def inspect_command(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="A file or folder of mapfusion's.")],
) -> None:
    """Show the content of a file or folder of mapfusion: `mapfusion inspect R1.parquet`."""
    from experiments.reports.inspect import inspect

    inspect(path)


@app.command(rich_help_panel=options.LOOK)
def docs(
    page: Annotated[
        str | None, typer.Argument(metavar="[PAGE]", help="Name of a page; lists all without.")
    ] = None,
) -> None:
    """Show a page of the manual: `mapfusion docs formats`."""
    from experiments.reports import layout

    if page is None:
        layout.print_pages()
    else:
        layout.print_page(page)


@app.command(rich_help_panel=options.RUN)
def check(
    scenarios: options.ScenarioNames,
    *,
    seeds: options.Seeds = "0",
    aligners: options.Aligners,
    overrides: options.Overrides,
    jobs: options.Jobs = options.ALL_CORES,
    fresh: options.Fresh = False,
    junit: Annotated[Path | None, typer.Option(help="Write a JUnit report to this file.")] = None,
    results: options.Results = options.RESULTS,
    output: options.DocumentFile = None,
    as_json: options.AsJson = False,
) -> None:
    """Check the metrics that scenarios expect, exit code 1 if one fails: `mapfusion check ci`.

    A run that merges no two maps although some have common ground fails, too. Exit code 2 if a
    scenario cannot be run. No scenario runs if one of them cannot be read.
    """
    from experiments.cli.options import DOCUMENT, JUNIT, require_file
    from experiments.evaluation.metrics import CheckedScenario, check_all
    from experiments.reports import export, layout, run_screen
    from experiments.scenario.settings import AnyScenario
    from experiments.scenario.suite import parse_seeds

    require_file("--output", output, DOCUMENT, scenarios)
    require_file("--junit", junit, JUNIT, scenarios)

    def run_one(scenario: AnyScenario) -> Path:
        from experiments.evaluation.result import run_scenario  # as in `run`

        with layout.progress() as show:
            return run_scenario(scenario, results, jobs, show, fresh)

    checks: list[CheckedScenario] = []
    try:
        for checked in check_all(scenarios, parse_seeds(seeds), overrides, run_one, aligners):
            checks.append(checked)
            if checked.error:
                options.print_to_stderr(checked.error)
        if not as_json:
            run_screen.print_checks(checks)
        export.publish_json("check", export.check_document(checks), as_json, output)
    finally:
        if junit is not None:
            export.write_junit(junit, checks)
    if not all(check.passed for check in checks):
        is_bad = any(check.error for check in checks)
        raise typer.Exit(options.EXIT_BAD_INPUT if is_bad else options.EXIT_FAILED)


@app.command("scenarios", rich_help_panel=options.RUN)
def list_scenarios(
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="[FOLDER]", help="Of scenario files; the suite's by default."),
    ] = None,
    *,
    copy: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Write scenarios/NAME.yaml and its schema instead, to edit.",
            autocompletion=complete_scenario,
        ),
    ] = None,
    aligners: Annotated[
        bool, typer.Option("--aligners", help="List the aligners that `--aligner` takes instead.")
    ] = False,
    schema: Annotated[
        bool, typer.Option("--schema", help="Print their JSON schema instead, for editors.")
    ] = False,
) -> None:
    """List the suite, with the tags that `run` and `check` take: `mapfusion scenarios`."""
    from experiments.scenario.suite import entries

    if copy is not None:
        from experiments.scenario.suite import copy_to_edit

        for path in copy_to_edit(copy):
            typer.echo(path)
        return
    if schema:
        from experiments.scenario.loading import schema_text

        typer.echo(schema_text(), nl=False)
        return
    from experiments.reports import layout

    if aligners:
        layout.print_methods()
    else:
        layout.print_scenarios(entries(folder))
