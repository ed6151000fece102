"""Stereo recordings as logs, with the settings and files that a user gives."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from experiments.scenario.loading import made_settings
from experiments.scenario.settings import SimulatedScenario
from experiments.scenario.suite import settings_of
from mapfusion.calibration_error import CalibrationError
from mapfusion.errors import InputError
from mapfusion.recordings.levels import Level
from mapfusion.recordings.stereo_import import Cut, Imported, StereoImport, write_imported
from mapfusion.recordings.stereo_recording import StereoRecording
from mapfusion.recordings.tum import read_tum
from mapfusion.vision.frontend import FrontEndParameters

BY_IMAGES = "images"  # in place of a file of odometry


@dataclass(frozen=True)
class ImportedRecording:
    """What was made of a recording.

    Attributes:
        recording: what was read.
        camera: the rectified pair, as a line for people.
        robots: their logs.
        folders: where these are.
    """

    recording: StereoRecording
    camera: str
    robots: list[Imported]
    folders: list[Path]

    @property
    def too_little(self) -> list[str]:
        """Of each robot that carries too little to map, a line that says so."""
        return [one.too_little for one in self.robots if one.too_little]


def import_stereo(
    recording: StereoRecording,
    destination: Path,
    cuts: Sequence[Cut],
    trajectories: tuple[str | None, Path | None],
    vision: tuple[FrontEndParameters | None, Sequence[str]],
    calibration: Sequence[str],
    level: Level,
    on_progress: Callable[[str, int, int], None],
) -> ImportedRecording:
    """Make and write the logs of a recording's robots.

    Args:
        recording: what was read.
        destination: each robot's folder goes there.
        cuts: the robots.
        trajectories: files of odometry (or `images`: of the pictures) and truth in place of the
            recording's own.
        vision: settings of the front end, None for what follows from the camera, and what of them
            is replaced: `KEY=VALUE`.
        calibration: what is replaced of what is left open of the camera: `KEY=VALUE`.
        level: where the robots' attitudes are known from.
        on_progress: told what is done.

    Raises:
        InputError: names file or setting; nothing is written then.
    """
    (odometry, truth), (chosen, overrides) = trajectories, vision
    if odometry is not None:
        recorded = None if odometry == BY_IMAGES else read_tum(Path(odometry))
        recording = replace(recording, odometry=recorded)
    if truth is not None:
        recording = replace(recording, truth=read_tum(truth))

    def adjusted(derived: FrontEndParameters) -> FrontEndParameters:
        base = asdict(derived if chosen is None else chosen)
        return made_settings("--vision", FrontEndParameters, overrides, base)

    def known(usual: CalibrationError) -> CalibrationError:
        return made_settings("--calibration", CalibrationError, calibration, asdict(usual))

    work = StereoImport(recording, adjusted, known)
    robots = [work.log_of(cut, on_progress, level) for cut in cuts]
    camera, left = work.camera, work.calibration_error
    about = (
        f"{camera.width_px}x{camera.height_px} px, f {camera.focal_px:.1f} px, "
        f"baseline {camera.baseline_m:.3f} m, depths {work.vision.stereo.min_depth_m:.2g} to "
        f"{work.vision.max_depth_m:.2g} m; known to {1e3 * left.heading_rad:.2g} mrad and "
        f"{100 * left.scale:.2g} % of lengths"
    )
    return ImportedRecording(recording, about, robots, write_imported(destination, robots))


def vision_of(scenario: str) -> FrontEndParameters:
    """The settings of the front end of a simulation, by file or name; raises InputError."""
    settings = settings_of(scenario)
    if not isinstance(settings, SimulatedScenario):
        raise InputError(f"--scenario {scenario}: is no simulation, and has no section vision")
    return settings.vision
