"""Commands that convert recordings in other formats into robot logs, one for each format."""

import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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

app = typer.Typer(no_args_is_help=True, help="Turn recordings in foreign formats into robot logs.")
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
            found = list(check_log(log, stated.motion).findings)
            sound = not any(finding.kind == "odometry" for finding in found)
            if truth is not None and (wrong := finding_of_truth(log, truth, stated.motion, sound)):
                found.append(wrong)
            findings += [(log.robot, finding) for finding in found]
            chosen = f"associated by {association_for(log, stated.association)}"
            counts = f"{len(log)} frames, {len(log.observations)} observations"
            print_lines([f"{log.robot}: {counts}, {chosen} (slam.filter.association)"])
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
    app.command(_name, help=f"{_importer.what}: {_usage}.")(_make(_name))
