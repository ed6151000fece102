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
    from experiments.reports.terminal.layout import print_paths, progress
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
    output: options.Output,
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
    from experiments.reports import export
    from experiments.reports.terminal import layout
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
    aligners: options.Aligners,
    scenario: options.SettingsOf = None,
    overrides: options.Overrides,
    seed: options.Seed = None,
    sigma_m: options.SigmaM = None,
    require_accepted: Annotated[
        bool, typer.Option("--require-accepted", help="Exit code 1 if no estimate is accepted.")
    ] = False,
    as_json: options.AsJson = False,
) -> None:
    """Estimate T_a_b with every aligner: `mapfusion align R1.parquet R2.parquet`.

    T_a_b is the pose of map b in the frame of map a: p_a = R(theta) p_b + (tx, ty). Exit code 0
    also if no estimate is accepted, unless you ask for one with `--require-accepted`.
    """
    from experiments.cli.options import DOCUMENT, require_file
    from experiments.evaluation import single_steps as single
    from experiments.reports import export
    from experiments.reports.terminal.layout import print_lines
    from experiments.reports.terminal.run_screen import print_estimates, print_verdict
    from experiments.scenario.suite import settings_of, with_aligners
    from mapfusion.align.alignment import Status

    require_file("--output", output, DOCUMENT, [map_a, map_b, scenario])
    options.announce_compilation(as_json)
    overrides = with_aligners(scenario, overrides, aligners)
    settings = settings_of(scenario, overrides, seed)
    rows = []
    for row in single.align(map_a, map_b, settings, sigma_m):
        rows.append(row)
        if not as_json:
            print_verdict(row)
    accepted = any(single.final_status(row)[0] is Status.ACCEPTED for row in rows)
    note = "" if accepted else single.align_note(map_a, map_b, settings, sigma_m)
    found = export.alignment_document((map_a, map_b), settings.seed, rows, note)
    export.publish_json("align", found, as_json, output)
    if not as_json:
        print_estimates(rows)
        print_lines([note] if note else [])
    if require_accepted and not accepted:
        options.print_to_stderr(f"{map_a} and {map_b}: no estimate of T_a_b is accepted")
        raise typer.Exit(options.EXIT_FAILED)


@app.command(rich_help_panel=options.STEPS)
def merge(
    maps: Annotated[list[Path], typer.Argument(metavar="MAP MAP...", help="Two maps or more.")],
    *,
    output: options.Output,
    aligners: options.Aligners,
    scenario: options.SettingsOf = None,
    overrides: options.Overrides,
    seed: options.Seed = None,
    sigma_m: options.SigmaM = None,
    as_json: options.AsJson = False,
) -> None:
    """Fuse maps that alignments connect: `mapfusion merge A.parquet B.parquet -o F.parquet`.

    Exit code 1, and nothing is written, if no two maps were merged.
    """
    from experiments.cli.options import require_map_file
    from experiments.evaluation import single_steps as single
    from experiments.reports import export
    from experiments.reports.terminal.layout import print_lines
    from experiments.reports.terminal.run_screen import print_fused, print_unmerged
    from experiments.scenario.suite import settings_of, with_aligners

    require_map_file(output, [*maps, scenario], n_maps=max(len(maps) // 2, 1))
    options.announce_compilation(as_json)
    overrides = with_aligners(scenario, overrides, aligners)
    settings = settings_of(scenario, overrides, seed)
    merged = single.merge(maps, settings, sigma_m)
    paths = single.save_fused(output, merged)
    found = export.fusion_document(paths, settings.seed, merged, maps)
    export.publish_json("merge", found, as_json)
    if not paths:
        if not as_json:
            print_unmerged(merged, maps)
        options.print_to_stderr(f"no two maps were merged; {output} is not written")
        raise typer.Exit(options.EXIT_FAILED)
    if not as_json:
        for path, fused in zip(paths, merged.fusion.fused, strict=True):
            print_fused(path, fused, maps, merged.aligner, merged.is_lower_bound(fused))
        print_lines([f"  note: {merged.note}"] if merged.note else [])
