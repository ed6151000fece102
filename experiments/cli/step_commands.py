"""Commands that do one step on files: record, slam, align, merge."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from experiments.cli import options

app = typer.Typer()


@app.command(rich_help_panel=options.STEPS)
def record(
    scenario: options.OneScenario,
    *,
    output: options.Output,
    seed: options.Seed = None,
    overrides: options.Overrides,
    jobs: options.Jobs = options.ALL_CORES,
    results: options.Results = options.RESULTS,
    kind: options.Format = "log",
) -> None:
    """Simulate, and write the log and truth of each robot: `mapfusion record S -o logs`.

    `--format` writes images, odometry and truth for other programs, see `mapfusion docs
    recordings`.
    """
    from experiments.cli.options import require_folder
    from experiments.evaluation import single_steps as single
    from experiments.evaluation.metrics import load_checked
    from experiments.evaluation.single_steps import write_drives
    from experiments.reports.layout import print_paths, progress
    from experiments.scenario.suite import one_scenario

    require_folder(output, [scenario])
    loaded = load_checked(one_scenario(scenario), overrides, seed)
    with progress() as show:
        if kind == "log":
            paths = single.record(loaded, output, results, jobs, show)
        else:
            paths = write_drives(loaded, kind, output, results, jobs, show)
    print_paths(output, paths)


@app.command(rich_help_panel=options.STEPS)
def slam(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A robot log (folder).")],
    *,
    output: options.MapFile,
    scenario: options.SettingsOf = None,
    overrides: options.Overrides,
    seed: options.Seed = None,
    noise: Annotated[
        Literal["from_log", "stated"] | None,
        typer.Option(
            help="Odometry noise: enlarged if the log shows that it is larger, or as stated. "
            "[default: slam.noise, from_log]",
            show_default=False,
        ),
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth/--no-smooth", help="Write the smoothed map, too.")
    ] = True,
    as_json: options.AsJson = False,
) -> None:
    """Build one robot's map from its log: `mapfusion slam logs/R1 -o R1.parquet`.

    The map of the filter is R1.parquet. The smoothed map, R1.smoothed.parquet, is the better one to
    align and merge. Exit code 1 if the map is empty or most of the log's observations contradict
    it.
    """
    from experiments.cli.options import require_map_file
    from experiments.evaluation import single_steps as single
    from experiments.reports import export, layout
    from experiments.scenario.suite import settings_of

    require_map_file(output, [log, scenario])
    options.announce_compilation(as_json)
    overrides = overrides if noise is None else [*overrides, f"slam.noise={noise}"]
    settings = settings_of(scenario, overrides, seed)
    with layout.progress() as show:
        made = single.slam(log, settings, show, smooth)
    landmarks = made.landmarks
    paths = single.save_maps(output, made)
    told = export.map_document(paths, log, settings.seed, landmarks, made.findings)
    export.publish_json("slam", told, as_json)
    if not as_json:
        lines = [f"{len(landmarks)} landmarks of {landmarks.name} in {output}"]
        if made.smoothed is not None:
            lines.append(f"{len(made.smoothed)} landmarks, smoothed, in {paths[-1]}")
        layout.print_lines(lines)
    if made.not_smoothed:
        options.print_to_stderr(f"warning: {log}: not smoothed: {made.not_smoothed}")
    for finding in made.findings:
        if finding.kind != "gate":  # this finding makes the map unusable, see below
            options.print_to_stderr(f"warning: {log}: {finding.text}")
    if made.unusable:
        options.print_to_stderr(f"{log}: {made.unusable}")
        raise typer.Exit(options.EXIT_FAILED)


@app.command(rich_help_panel=options.STEPS)
def align(
    map_a: Annotated[Path, typer.Argument(metavar="MAP_A")],
    map_b: Annotated[Path, typer.Argument(metavar="MAP_B")],
    *,
    output: options.DocumentFile = None,
    report: options.ReportFile = None,
    plot: options.PlotFile = None,
    aligners: options.Aligners,
    scenario: options.SettingsOf = None,
    overrides: options.Overrides,
    seed: options.Seed = None,
    sigma_m: options.SigmaM = None,
    descriptor_metric: options.DescriptorMetric = "",
    require_accepted: Annotated[
        bool, typer.Option("--require-accepted", help="Exit code 1 if no estimate is accepted.")
    ] = False,
    as_json: options.AsJson = False,
) -> None:
    """Estimate T_a_b with every aligner: `mapfusion align R1.parquet R2.parquet`.

    T_a_b is the pose of map b in the frame of map a: p_a = R(theta) p_b + (tx, ty). Exit code 0
    also if no estimate is accepted, unless you ask for one with `--require-accepted`.
    """
    from experiments.cli.options import DOCUMENT, require_file, require_pictures
    from experiments.evaluation import single_steps as single
    from experiments.reports import export
    from experiments.reports.layout import progress
    from experiments.reports.report.maps_page import write_pictures
    from experiments.reports.run_screen import print_alignments
    from experiments.scenario.suite import settings_of, with_aligners

    require_file("--output", output, DOCUMENT, [map_a, map_b, scenario])
    require_pictures(report, plot, [map_a, map_b, scenario])
    options.announce_compilation(as_json)
    overrides = with_aligners(scenario, overrides, aligners)
    settings = settings_of(scenario, overrides, seed)
    found, n_aligners = [], len(settings.align.aligners)
    with progress(quiet=as_json) as show:
        for each in single.align(map_a, map_b, settings, sigma_m, descriptor_metric):
            found.append(each)
            show("align", len(found), n_aligners)
    document = export.alignment_document((map_a, map_b), settings.seed, found)
    export.publish_json("align", document, as_json, output)
    write_pictures(report, plot, found, (map_a, map_b), settings.seed)
    if not as_json:
        print_alignments(found)
    if require_accepted and not any(each.accepted for each in found):
        options.print_to_stderr(f"{map_a} and {map_b}: no estimate of T_a_b is accepted")
        raise typer.Exit(options.EXIT_FAILED)


@app.command(rich_help_panel=options.STEPS)
def merge(
    maps: Annotated[list[Path], typer.Argument(metavar="MAP MAP...", help="Two maps or more.")],
    *,
    output: options.MapFile,
    report: options.ReportFile = None,
    plot: options.PlotFile = None,
    aligners: options.Aligners,
    scenario: options.SettingsOf = None,
    overrides: options.Overrides,
    seed: options.Seed = None,
    sigma_m: options.SigmaM = None,
    descriptor_metric: options.DescriptorMetric = "",
    as_json: options.AsJson = False,
) -> None:
    """Fuse maps that alignments connect: `mapfusion merge A.parquet B.parquet -o F.parquet`.

    Exit code 1, and no map is written, if no two maps were merged; a report and a picture then show
    why.
    """
    from experiments.cli.options import require_map_file, require_pictures
    from experiments.evaluation import single_steps as single
    from experiments.reports import export
    from experiments.reports.report.maps_page import write_pictures
    from experiments.reports.run_screen import print_merged
    from experiments.scenario.suite import settings_of, with_aligners

    require_map_file(output, [*maps, scenario], n_maps=max(len(maps) // 2, 1))
    require_pictures(report, plot, [*maps, scenario])
    options.announce_compilation(as_json)
    overrides = with_aligners(scenario, overrides, aligners)
    settings = settings_of(scenario, overrides, seed)
    merged = single.merge(maps, settings, sigma_m, descriptor_metric)
    paths = single.save_fused(output, merged)
    found = export.fusion_document(paths, settings.seed, merged, maps)
    export.publish_json("merge", found, as_json)
    write_pictures(report, plot, merged, maps, settings.seed)
    if not as_json:
        print_merged(merged, maps, paths)
    if not paths:
        options.print_to_stderr(f"no two maps were merged; {output} is not written")
        raise typer.Exit(options.EXIT_FAILED)
