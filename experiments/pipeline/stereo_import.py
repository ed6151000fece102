"""Import of stereo recordings with a user's settings and calibration files."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.pipeline.workers import workers
from experiments.scenario.loading import made_settings
from experiments.scenario.settings import SimulatedScenario
from experiments.scenario.suite import settings_of
from experiments.scenario.yaml_files import read_calibration
from mapfusion.camera import CalibrationError
from mapfusion.datasets.formats import AttitudeSource, read_recording
from mapfusion.datasets.stereo_import import (
    Imported,
    OnProgress,
    RecordingPart,
    StereoImport,
    write_imported,
)
from mapfusion.datasets.stereo_recording import StereoRecording
from mapfusion.datasets.text_files import read_odometry, read_tum
from mapfusion.errors import InputError
from mapfusion.vision.front_end import FrontEndParameters

BY_IMAGES = "images"  # visual odometry, in place of an odometry file


@dataclass(frozen=True)
class Source:
    """Stereo recording with the user's settings.

    Attributes:
        format_name: name in `mapfusion.datasets.formats.IMPORTERS`.
        folder: folder of the recording.
        settings: settings of the format.
        odometry: file in place of the recording's odometry, or `images` for visual odometry.
        truth: file in place of the recording's truth.
        vision: settings of the front end; None: settings derived from the camera.
        vision_overrides: replaced settings of the front end, `KEY=VALUE`.
        calibration: replaced values of the calibration error, `KEY=VALUE`.
        level: source of the robots' attitudes.
    """

    format_name: str
    folder: Path
    settings: Any
    odometry: str | None = None
    truth: Path | None = None
    vision: FrontEndParameters | None = None
    vision_overrides: tuple[str, ...] = ()
    calibration: tuple[str, ...] = ()
    level: AttitudeSource = "auto"

    def read(self) -> StereoRecording:
        """Read the recording with the user's trajectories; raises InputError."""
        recording = read_recording(self.format_name, self.folder, self.settings, read_calibration)
        if self.odometry is not None:
            recorded = None if self.odometry == BY_IMAGES else read_odometry(Path(self.odometry))
            recording = replace(recording, odometry=recorded)
        if self.truth is not None:
            recording = replace(recording, truth=read_tum(self.truth))
        return recording

    def adjusted(self, derived: FrontEndParameters) -> FrontEndParameters:
        """Return the settings of the front end, given the derived ones."""
        base = asdict(derived if self.vision is None else self.vision)
        return made_settings("--vision", FrontEndParameters, self.vision_overrides, base)

    def known(self, usual: CalibrationError) -> CalibrationError:
        """Return the calibration error, given the usual one."""
        return made_settings("--calibration", CalibrationError, self.calibration, asdict(usual))


@dataclass(frozen=True)
class ImportedRecording:
    """Imported logs of a recording.

    Attributes:
        about: description of the recording and its rectified pair in one line.
        dropped: dropped images, each with the reason.
        robots: imported robots.
    """

    about: str
    dropped: tuple[str, ...]
    robots: list[Imported]

    @property
    def too_little(self) -> list[str]:
        """Messages about robots whose data do not suffice for a map."""
        return [one.too_little for one in self.robots if one.too_little]


def import_recording(
    source: Source,
    recording: StereoRecording,
    cuts: Sequence[RecordingPart],
    on_progress: OnProgress,
) -> ImportedRecording:
    """Import the logs of some robots of a recording; raises InputError."""
    work = StereoImport(recording, source.adjusted, source.known)
    robots = [work.log_of(cut, on_progress, source.level) for cut in cuts]
    camera, left = work.camera, work.calibration_error
    about = (
        f"{recording.name}: {len(recording)} pairs; rectified {camera.width_px}x{camera.height_px} "
        f"px, f {camera.focal_px:.1f} px, baseline {camera.baseline_m:.3f} m, depths "
        f"{work.vision.stereo.min_depth_m:.2g} to {work.vision.max_depth_m:.2g} m; known to "
        f"{1e3 * left.heading_rad:.2g} mrad and {100 * left.scale:.2g} % of lengths"
    )
    if recording.depth is not None:
        depth_m = recording.pair(0)[1]
        known_m = depth_m[np.isfinite(depth_m)]
        median = f"{np.median(known_m):.2g} m" if len(known_m) else "unknown"
        about += f"; median depth of the first picture {median}"
    return ImportedRecording(about, recording.dropped, robots)


def import_stereo(
    sources: Sequence[Source],
    destination: Path,
    cuts_of: Callable[[StereoRecording], list[RecordingPart]],
    jobs: int,
    on_progress: OnProgress,
) -> tuple[list[ImportedRecording], list[Path]]:
    """Import the robots of some recordings and write their logs.

    Args:
        sources: recordings.
        destination: folder for the folders of the robots.
        cuts_of: function that returns the robots of a recording.
        jobs: number of processes.
        on_progress: called with the progress.

    Returns:
        Imported recordings, and the folders of the logs.

    Raises:
        InputError: a file or setting is invalid, or two robots have the same name; nothing is
            written then.
    """
    recordings = [source.read() for source in sources]
    robots = [cuts_of(recording) for recording in recordings]
    names = [cut.robot for cuts in robots for cut in cuts]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"two robots are named {twice[0]}; name them by --frames NAME=FROM:TO")
    if jobs == 1 or len(names) == 1:
        each = zip(sources, recordings, robots, strict=True)
        done = [import_recording(*one, on_progress) for one in each]
    else:  # each robot in a process, which reads its recording
        tags = [(n, k) for n, cuts in enumerate(robots) for k in range(len(cuts))]
        found: dict[tuple[int, int], ImportedRecording] = {}
        with workers(min(jobs, len(tags))) as pool:
            for n, k in tags:
                pool.submit((n, k), _import_robot, sources[n], robots[n][k])
            for tag, one in pool.completed():
                found[tag] = one
                on_progress("import robots", len(found), len(tags))
        done = [
            replace(found[n, 0], robots=[found[n, k].robots[0] for k in range(len(cuts))])
            for n, cuts in enumerate(robots)
        ]
    return done, write_imported(destination, [log for one in done for log in one.robots])


def _import_robot(source: Source, cut: RecordingPart) -> ImportedRecording:
    """Import one robot in a worker process."""
    return import_recording(source, source.read(), [cut], lambda *_: None)


def vision_of(scenario: str) -> FrontEndParameters:
    """Return the front end's settings of a simulation, by file or name; raises InputError."""
    settings = settings_of(scenario)
    if not isinstance(settings, SimulatedScenario):
        raise InputError(f"--scenario {scenario}: is no simulation, and has no section vision")
    return settings.vision
