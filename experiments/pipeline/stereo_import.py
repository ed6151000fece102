"""Import of stereo recordings with a user's settings and calibration files."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from experiments.pipeline.workers import workers
from experiments.scenario.loading import made_settings
from experiments.scenario.settings import SimulatedScenario
from experiments.scenario.suite import settings_of
from experiments.scenario.yaml_files import read_calibration
from mapfusion.datasets.formats import Level, read_recording
from mapfusion.datasets.stereo_import import Cut, Imported, OnProgress, StereoImport, write_imported
from mapfusion.datasets.stereo_recording import StereoRecording
from mapfusion.datasets.tum import read_odometry, read_tum
from mapfusion.errors import InputError
from mapfusion.geometry.camera import CalibrationError
from mapfusion.vision.front_end import FrontEndParameters

BY_IMAGES = "images"  # in place of a file of odometry


@dataclass(frozen=True)
class Source:
    """A stereo recording, and what a user says of it.

    Attributes:
        format_name: of `mapfusion.datasets.formats.IMPORTERS`.
        folder: of the recording.
        settings: of the format.
        odometry: a file, or `images`: of the pictures, in place of the recording's own.
        truth: a file in place of the recording's own.
        vision: settings of the front end; None: what follows from the camera.
        vision_overrides: what of them is replaced: `KEY=VALUE`.
        calibration: what is replaced of what is left open of the camera: `KEY=VALUE`.
        level: where the robots' attitudes are known from.
    """

    format_name: str
    folder: Path
    settings: Any
    odometry: str | None = None
    truth: Path | None = None
    vision: FrontEndParameters | None = None
    vision_overrides: tuple[str, ...] = ()
    calibration: tuple[str, ...] = ()
    level: Level = "auto"

    def read(self) -> StereoRecording:
        """The recording with the trajectories that are given; raises InputError."""
        recording = read_recording(self.format_name, self.folder, self.settings, read_calibration)
        if self.odometry is not None:
            recorded = None if self.odometry == BY_IMAGES else read_odometry(Path(self.odometry))
            recording = replace(recording, odometry=recorded)
        if self.truth is not None:
            recording = replace(recording, truth=read_tum(self.truth))
        return recording

    def adjusted(self, derived: FrontEndParameters) -> FrontEndParameters:
        """Settings of the front end, given those that follow from the camera."""
        base = asdict(derived if self.vision is None else self.vision)
        return made_settings("--vision", FrontEndParameters, self.vision_overrides, base)

    def known(self, usual: CalibrationError) -> CalibrationError:
        """What calibration leaves open, given what it usually does."""
        return made_settings("--calibration", CalibrationError, self.calibration, asdict(usual))


@dataclass(frozen=True)
class ImportedRecording:
    """What was made of a recording.

    Attributes:
        about: the recording and its rectified pair, as a line for people.
        dropped: pictures without a partner, and why.
        robots: their logs.
    """

    about: str
    dropped: tuple[str, ...]
    robots: list[Imported]

    @property
    def too_little(self) -> list[str]:
        """Of each robot that carries too little to map, a line that says so."""
        return [one.too_little for one in self.robots if one.too_little]


def import_recording(
    source: Source, recording: StereoRecording, cuts: Sequence[Cut], on_progress: OnProgress
) -> ImportedRecording:
    """Make the logs of some robots of a recording that `source` read; raises InputError."""
    work = StereoImport(recording, source.adjusted, source.known)
    robots = [work.log_of(cut, on_progress, source.level) for cut in cuts]
    camera, left = work.camera, work.calibration_error
    about = (
        f"{recording.name}: {len(recording)} pairs; rectified {camera.width_px}x{camera.height_px} "
        f"px, f {camera.focal_px:.1f} px, baseline {camera.baseline_m:.3f} m, depths "
        f"{work.vision.stereo.min_depth_m:.2g} to {work.vision.max_depth_m:.2g} m; known to "
        f"{1e3 * left.heading_rad:.2g} mrad and {100 * left.scale:.2g} % of lengths"
    )
    return ImportedRecording(about, recording.dropped, robots)


def import_stereo(
    sources: Sequence[Source],
    destination: Path,
    cuts_of: Callable[[StereoRecording], list[Cut]],
    jobs: int,
    on_progress: OnProgress,
) -> tuple[list[ImportedRecording], list[Path]]:
    """Make and write the logs of the robots of some recordings.

    Args:
        sources: the recordings.
        destination: each robot's folder goes there.
        cuts_of: the robots of a recording.
        jobs: processes, which share out the robots.
        on_progress: told what is done.

    Returns:
        What was made of each recording, and the folders of the logs.

    Raises:
        InputError: names file or setting, or a name that two robots have; nothing is written then.
    """
    recordings = [source.read() for source in sources]
    robots = [cuts_of(recording) for recording in recordings]
    names = [cut.robot for cuts in robots for cut in cuts]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"two robots are named {twice[0]}; name them by --frames NAME=FROM:TO")
    if jobs == 1 or len(names) == 1:
        each = zip(sources, recordings, robots, strict=True)
        done = [import_recording(*one, on_progress) for one in each]
    else:
        done = _shared_out(sources, robots, jobs, on_progress)
    return done, write_imported(destination, [log for one in done for log in one.robots])


def _shared_out(
    sources: Sequence[Source], robots: Sequence[list[Cut]], jobs: int, on_progress: OnProgress
) -> list[ImportedRecording]:
    """Each robot by a process, which reads its recording for itself."""
    tags = [(n, k) for n, cuts in enumerate(robots) for k in range(len(cuts))]
    found: dict[tuple[int, int], ImportedRecording] = {}
    with workers(min(jobs, len(tags))) as pool:
        for n, k in tags:
            pool.submit((n, k), _one_robot, sources[n], robots[n][k])
        for tag, one in pool.completed():
            found[tag] = one
            on_progress("import robots", len(found), len(tags))
    return [
        replace(found[n, 0], robots=[found[n, k].robots[0] for k in range(len(cuts))])
        for n, cuts in enumerate(robots)
    ]


def _one_robot(source: Source, cut: Cut) -> ImportedRecording:
    return import_recording(source, source.read(), [cut], lambda *_: None)


def vision_of(scenario: str) -> FrontEndParameters:
    """The settings of the front end of a simulation, by file or name; raises InputError."""
    settings = settings_of(scenario)
    if not isinstance(settings, SimulatedScenario):
        raise InputError(f"--scenario {scenario}: is no simulation, and has no section vision")
    return settings.vision
