"""Commands that do one step on files: record, import, slam, align, merge."""

import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from experiments.cli import options
from mapfusion.datasets.formats import (
    IMPORTERS,
    AttitudeSource,
    import_recording,
    robot_name,
    settings_class,
)
from mapfusion.errors import InputError

if TYPE_CHECKING:
    from mapfusion.datasets.log_consistency import Finding
    from mapfusion.datasets.stereo_import import RecordingPart

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


# `mapfusion import FORMAT` turns recordings into robot logs; a command for each format.
import_app = typer.Typer(
    no_args_is_help=True, help="Turn recordings in foreign formats into robot logs."
)
Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="The recording.")]
Folders = Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="The recordings.")]
Frames = Annotated[
    list[str] | None,
    typer.Option(
        "--frames",
        metavar="[NAME=]FROM:TO",
        help="Pairs that are one robot, a slice (FROM:TO:STEP, too); may be repeated.",
    ),
]
Odometry = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|images",
        help="Dead reckoning of the robot, in the TUM format, or what the pictures tell; "
        "by default as recorded, else by the pictures.",
    ),
]
Truth = Annotated[Path | None, typer.Option(help="True poses of the robot in the world, likewise.")]
VisionOverrides = Annotated[
    list[str] | None,
    typer.Option(
        "--vision",
        metavar="KEY=VALUE",
        help="Replaces a setting of the front end, e.g. harris.max_corners=300.",
    ),
]
CalibrationOverrides = Annotated[
    list[str] | None,
    typer.Option(
        "--calibration",
        metavar="FILE|KEY=VALUE",
        help="A calibration file (rosbag, images, tum_rgbd; layout of Kalibr or OpenCV), or a "
        "standard deviation of what is left open of camera and mount: heading_rad=0.001, "
        "scale=0.002; 0 of both: it is known exactly.",
    ),
]
LevelOf = Annotated[
    AttitudeSource,
    typer.Option(
        help="Where the robot's roll, pitch and height are known from: the mount (a level body), "
        "odometry that tilts, the pictures' motions from a level beginning, or with the floor that "
        "they show, or with an IMU's accelerations. By default as odometry is recorded, else the "
        "IMU, else the pictures."
    ),
]
_CUT = re.compile(r"(?:(?P<name>[^=]*)=)?(?P<rows>-?\d*:-?\d*(?::\d*)?)")
_NAME = re.compile("[A-Za-z0-9][A-Za-z0-9_-]{0,40}")  # the same names as in scenarios


def _log_command(format_name: str) -> Callable[..., None]:
    """Return the command that imports logs of a format."""

    def command(folder: Folder, output: options.Output, overrides: options.ImportOverrides) -> None:
        from experiments.cli.options import require_folder
        from experiments.evaluation.evaluated_run import finding_of_truth
        from experiments.reports.layout import print_lines, print_paths
        from experiments.scenario.loading import made_settings
        from mapfusion.datasets.log_consistency import check_log
        from mapfusion.fastslam.filter import FastSlamParameters
        from mapfusion.fastslam.mapping import association_for
        from mapfusion.robot_log import read_log, read_true_poses

        require_folder(output, [folder])
        settings = made_settings(format_name, settings_class(format_name), overrides)
        paths = import_recording(format_name, folder, output, settings)
        findings: list[tuple[str, Finding]] = []
        for path in paths:
            log, truth, stated = read_log(path), read_true_poses(path), FastSlamParameters()
            checked = check_log(log, stated.motion)
            found = list(checked.findings)
            sound = not any(finding.kind == "odometry" for finding in found)
            if truth is not None and (wrong := finding_of_truth(log, truth, stated.motion, sound)):
                found.append(wrong)
            findings += [(log.robot, finding) for finding in found]
            chosen = f"associated by {association_for(log, stated.association)}"
            counts = f"{len(log)} frames, {len(log.observations)} observations"
            print_lines([f"{log.robot}: {counts}, {chosen} (slam.filter.association)"])
            if checked.unchecked:
                options.print_to_stderr(f"warning: {log.robot}: {checked.unchecked}")
        print_paths(output, paths)
        _print_findings(findings, "observations", "maps of these logs would be wrong")

    return command


def _stereo_command(format_name: str) -> Callable[..., None]:
    """Return the command that makes logs of the stereo images of a format."""

    def command(
        folders: Folders,
        output: options.Output,
        overrides: options.ImportOverrides,
        frames: Frames = None,
        odometry: Odometry = None,
        truth: Truth = None,
        vision: VisionOverrides = None,
        scenario: options.SettingsOf = None,
        level: LevelOf = "auto",
        calibration: CalibrationOverrides = None,
        jobs: options.Jobs = options.ALL_CORES,
        **chosen: str | None,
    ) -> None:
        from experiments.cli.options import require_folder
        from experiments.pipeline.stereo_import import Source, import_stereo, vision_of
        from experiments.reports.layout import progress
        from experiments.reports.run_screen import print_imported
        from experiments.scenario.loading import made_settings

        require_folder(output, [*folders, odometry, truth, scenario])
        if len(folders) > 1 and (odometry not in (None, "images") or truth is not None):
            raise InputError("--odometry and --truth: are files of one recording; import one")
        named = {name: value for name, value in chosen.items() if value is not None}
        for file in [each for each in calibration or () if "=" not in each]:
            if "calibration" not in {each.name for each in fields(settings_class(format_name))}:
                raise InputError(f"--calibration {file}: {format_name} has files of its own")
            if not Path(file).is_file():
                raise InputError(f"--calibration {file}: no such file")
            named["calibration"] = str(Path(file).resolve())
        calibration = [each for each in calibration or () if "=" in each]
        settings = made_settings(format_name, settings_class(format_name), overrides, named)
        front_end = None if scenario is None else vision_of(scenario)
        given = (front_end, tuple(vision or ()), tuple(calibration), level)
        sources = [
            Source(format_name, folder, settings, odometry, truth, *given) for folder in folders
        ]
        with progress() as show:
            done, written = import_stereo(
                sources, output, lambda one: _cuts(robot_name(one.name), frames or ()), jobs, show
            )
        print_imported(done, written)
        findings = [
            (log.log.robot, finding)
            for one in done
            for log in one.robots
            for finding in log.findings
        ]
        too_little = [line for one in done for line in one.too_little]
        remedy = "maps of these logs would be wrong; --odometry images takes the pictures' own"
        _print_findings(findings, "pictures", remedy, too_little)

    # Typer reads the signature: replace `**chosen` by the options of the format.
    *shared, _ = inspect.signature(command).parameters.values()
    parameters = list(shared)
    for name, text in IMPORTERS[format_name].options.items():
        annotation = Annotated[str | None, typer.Option(help=text)]
        kind = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter(name, kind, default=None, annotation=annotation))
    command.__annotations__ = {each.name: each.annotation for each in parameters}
    setattr(command, "__signature__", inspect.Signature(parameters))  # noqa: B010
    return command


def _print_findings(
    findings: "Sequence[tuple[str, Finding]]",
    seen: str,
    remedy: str,
    too_little: Sequence[str] = (),
) -> None:
    """Print the findings about logs by robot; exit if maps of the logs would be wrong.

    Args:
        findings: names of the robots and findings.
        seen: source of the motions that the odometry is compared with.
        remedy: end of the message about odometry that contradicts them.
        too_little: messages about logs with too few observations.
    """
    for robot, finding in findings:
        options.print_to_stderr(f"warning: {robot}: {finding.text}")
    if too_little:
        options.print_to_stderr(too_little[0])
        raise typer.Exit(options.EXIT_FAILED)
    if any(finding.kind == "odometry" for _, finding in findings):
        options.print_to_stderr(f"odometry and {seen} contradict each other: {remedy}")
        raise typer.Exit(options.EXIT_FAILED)


def _cuts(recording: str, frames: Sequence[str]) -> "list[RecordingPart]":
    """Return the robots that `--frames` cuts a recording into; raise InputError."""
    from mapfusion.datasets.stereo_import import RecordingPart

    if not frames:
        return [RecordingPart(recording, slice(None))]
    cuts = []
    for number, text in enumerate(frames, start=1):
        match = _CUT.fullmatch(text)
        usual = recording if len(frames) == 1 else f"{recording}-{number}"
        name = usual if match is None or match["name"] is None else match["name"]
        if match is None or match["rows"].endswith(":0") or not _NAME.fullmatch(name):
            expected = "[NAME=]FROM:TO or FROM:TO:STEP, for example R1=0:500"
            raise InputError(f"--frames {text}: expected {expected}")
        bounds = [int(part) if part else None for part in match["rows"].split(":")]
        cuts.append(RecordingPart(name, slice(*bounds)))
    return cuts


for _name, _importer in IMPORTERS.items():
    _usage = f"`mapfusion import {_name} {_importer.example} -o logs/{_name}`"
    _make = _stereo_command if _importer.stereo else _log_command
    import_app.command(_name, help=f"{_importer.what}: {_usage}.")(_make(_name))
