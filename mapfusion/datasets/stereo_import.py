"""Import of stereo recordings: rectify, track, level, and split into robot logs.

What the defaults of `FrontEndParameters` say in metres was chosen for one head: what is meant are
disparities and shares of the image, and these are turned into metres of another camera. All else is
measured on the recording's own pictures: depths, what true surfaces differ by in two pictures
(`noise_model.py`), how many corners it takes, and how far true points stray from frame to frame.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapfusion.attitude import Attitude, write_attitude
from mapfusion.datasets.camera_calibration import Rectification
from mapfusion.datasets.formats import AttitudeSource
from mapfusion.datasets.levelling import (
    AttitudeMeasurements,
    LevelledFrames,
    choose_attitude_source,
)
from mapfusion.datasets.log_consistency import Finding, disagreement, truth_finding
from mapfusion.datasets.motion_agreement import Stated, pose_mistakes
from mapfusion.datasets.relative_motion import composed_spans, motions_between_frames
from mapfusion.datasets.stereo_recording import StereoRecording, sample_indices
from mapfusion.datasets.text_files import NS
from mapfusion.datasets.tum import TimedPoses
from mapfusion.errors import InputError, OutOfRangeError
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry import se3
from mapfusion.geometry.camera import CalibrationError, StereoCamera, usual_calibration
from mapfusion.geometry.numerics import Float
from mapfusion.robot_log import (
    TRUTH_FILES,
    RobotLog,
    write_log,
    write_odometry_covariance,
    write_truth_poses,
)
from mapfusion.vision.features import Features
from mapfusion.vision.front_end import FrontEnd, FrontEndParameters, Observer, joined
from mapfusion.vision.stereo_noise import limits_for, measured_noise, offsets
from mapfusion.vision.tracking import Tracks
from mapfusion.vision.visual_odometry import RigidMotion, robot_motions, visual_odometry

Pair = tuple[np.ndarray, np.ndarray]

_USUAL = StereoCamera()  # the head that the defaults are for
_USUAL_DEPTH_M = 3.5  # where that head's robots see walls, median
# By how much farther others go between two pictures, as a share of the depth, than robots that see
# walls at 3.5 m in steps of 0.1 m: a car's 1.2 m at a median of 21 m is twice as much, and the
# nearer half of what it sees another two times.
_ROBOT_STEP = 4.0
_AREA_PX = 300  # of the image for one corner at most: they keep 10 px apart, on texture
_MOST_CORNERS = 5000  # that the setting allows
# Share of true surfaces that keep all limits: a choice of how many to give up for those near edges,
# whose two pictures differ for another reason than noise. What passes is held against SGBM on KITTI
# (tests/mapfusion/datasets/test_real_recordings.py: 97 % within a pixel, 300 a frame).
_TRUE_SHARE = 0.8
_WANTED = 100  # observations a frame: a filter's step takes as long as it has of them
_MEDIAN_ERROR = 0.6745  # of a normal variable, in standard deviations
_SIDE_M = (0.01, 10.0)  # of the described window, what the setting allows


def front_end_for_camera(camera: StereoCamera) -> FrontEndParameters:
    """Settings by the camera alone: depths by disparity, shifts and corners by the image's size."""
    usual = FrontEndParameters()
    scale = camera.focal_px * camera.baseline_m / (_USUAL.focal_px * _USUAL.baseline_m)
    wide, high = camera.width_px / _USUAL.width_px, camera.height_px / _USUAL.height_px
    corners = camera.width_px * camera.height_px // _AREA_PX
    stereo = replace(
        usual.stereo,
        min_depth_m=usual.stereo.min_depth_m * scale / max(wide, 1.0),
        max_depth_m=usual.stereo.max_depth_m * scale,
        nearest_plane_m=usual.stereo.nearest_plane_m * camera.baseline_m / _USUAL.baseline_m,
    )
    tracks = replace(
        usual.tracks,
        max_shift_u_px=usual.tracks.max_shift_u_px * wide,
        max_shift_v_px=usual.tracks.max_shift_v_px * _ROBOT_STEP * high,
        max_disparity_ratio=usual.tracks.max_disparity_ratio**_ROBOT_STEP,
    )
    return replace(
        usual,
        harris=replace(usual.harris, max_corners=min(max(corners, 1), _MOST_CORNERS)),
        stereo=stereo,
        tracks=tracks,
        max_depth_m=usual.max_depth_m * scale,
        max_sigma_depth_m=usual.max_sigma_depth_m * scale,
    )


def front_end_for_recording(
    camera: StereoCamera, apart: Sequence[Pair], run: Sequence[Pair]
) -> FrontEndParameters:
    """Settings by the camera and by what a recording shows.

    Args:
        camera: the rectified pair.
        apart: pairs (H, W) uint8 from all over the recording.
        run: pairs that follow one another, for what tracks do.
    """
    vision = front_end_for_camera(camera)
    noise = measured_noise(apart, camera, vision.harris, vision.stereo)
    if noise is not None:
        stereo = limits_for(vision.stereo, noise, _TRUE_SHARE)
        tracks = replace(
            vision.tracks,
            noise_grey=noise.noise_grey,
            max_misfit_px=max(vision.tracks.max_misfit_px, noise.misfit_px),
        )
        vision = replace(vision, stereo=stereo, tracks=tracks)
    front_end = FrontEnd(camera, vision)
    depth_m = [
        camera.focal_px * camera.baseline_m / front_end.extract(*pair).disparity_px
        for pair in apart
    ]
    vision = scale_descriptor_window(vision, camera, np.concatenate([*depth_m, np.empty(0)]))
    front_end = FrontEnd(camera, vision)
    return _by_tracks(camera, vision, [front_end.extract(*pair) for pair in run])


def scale_descriptor_window(
    vision: FrontEndParameters, camera: StereoCamera, depth_m: Float
) -> FrontEndParameters:
    """With a described window that suits depths (N,) that were seen; as it is where none were.

    The side is the default's times a power of two, so that robots of one kind in like places
    describe alike.
    """
    if not len(depth_m):
        return vision
    usual_m = vision.usurf.side_m
    fits = np.median(depth_m) / _USUAL_DEPTH_M * _USUAL.focal_px / camera.focal_px
    side_m = usual_m * 2.0 ** float(np.round(np.log2(fits)))
    return replace(vision, usurf=replace(vision.usurf, side_m=float(np.clip(side_m, *_SIDE_M))))


def _by_tracks(
    camera: StereoCamera, vision: FrontEndParameters, frames: Sequence[Features]
) -> FrontEndParameters:
    """With as many corners as give the observations wanted, and noise as tracks have it."""
    observer = Observer.of(camera, vision)
    seen = [observer.observe(found).tracks for found in frames]
    strays = [
        reprojection_errors_px(camera, before, after)
        for before, after in itertools.pairwise(seen)
        if after.motion is not None
    ]
    if strays:
        # half of the errors lie within 0.67 deviations; two frames have a share in each
        sigma_px = float(np.median(np.abs(np.concatenate(strays)))) / _MEDIAN_ERROR / np.sqrt(2)
        vision = replace(vision, sigma_uv_px=float(max(vision.sigma_uv_px, sigma_px)))
    observer = Observer.of(camera, vision)
    lasting = [len(observer.observe(found).rows) for found in frames]
    usual = np.median(lasting[vision.tracks.min_length - 1 :] or [0])
    if usual > _WANTED:
        corners = int(vision.harris.max_corners * _WANTED / usual)
        vision = replace(vision, harris=replace(vision.harris, max_corners=corners))
    return vision


def reprojection_errors_px(camera: StereoCamera, before: Tracks, after: Tracks) -> Float:
    """By how much points of the tracks lie beside where the motion takes them (2N,), u and v.

    Only where a motion is known.
    """
    assert after.motion is not None
    _, old, new = np.intersect1d(before.track_id, after.track_id, return_indices=True)
    p_after, _ = camera.triangulate(after.uv_px[new], after.disparity_px[new], 1.0, 1.0)
    T = after.motion.T_before_after
    moved = camera.project(p_after @ T[:3, :3].T + T[:3, 3])
    return (moved[:, :2] - before.uv_px[old]).ravel()


# Windows of the row search are 17 px: what lies a row off is found there still, two rows cost
# half of the matches.
_MOST_ROWS_OFF = 1.0
_MOST_COLUMNS_AHEAD = 2.0  # what is far has no disparity, but for what calibration leaves open
_RUN = 8  # pairs that follow one another, on which tracks are tried
_LEAST_MATCHES = 20  # corners whose median row error is worth a refusal
_LONGEST_ODOMETRY_GAP_S = 1.0  # over which a trajectory is interpolated: wheels report often
_LONGEST_TRUTH_GAP_S = 0.1  # as in MRCLAM's recordings: the truth must not be guessed
_LEAST_OBSERVATIONS = 4  # a frame: one more than fix a motion
_MOST_GUESSED = 0.1  # of all motions: what lies between guesses must be longer than they are

OnProgress = Callable[[str, int, int], None]
Vision = Callable[[FrontEndParameters], FrontEndParameters]
Calibration = Callable[[CalibrationError], CalibrationError]


@dataclass(frozen=True)
class RecordingPart:
    """A robot, and which pairs of the recording are its frames."""

    robot: str
    rows: slice


@dataclass(frozen=True)
class Imported:
    """Import of one robot's frames.

    Attributes:
        log: as written.
        truth: (T, 3) T_world_robot, or None.
        linked: (T,) share of the features of the frame before that were found again; NaN for the
            first frame.
        odometry_covariance: (T, 3, 3) of odometry that the pictures told; None: it was recorded.
        attitude: by which the observations were levelled; None: the body was taken for level.
        guessed: frames whose motion too few links told.
        findings: what recorded odometry and truth contradict.
    """

    log: RobotLog
    truth: Float | None
    linked: Float
    odometry_covariance: Float | None = None
    attitude: Attitude | None = None
    guessed: int = 0
    findings: tuple[Finding, ...] = ()

    @property
    def observations(self) -> np.ndarray:
        """(T,) how many each frame has."""
        return np.diff(self.log.frame_starts())

    @property
    def too_little(self) -> str:
        """Why nothing can be mapped with it; empty where it can."""
        usual, n = float(np.median(self.observations)), len(self.log)
        if usual < _LEAST_OBSERVATIONS:
            seen = f"{usual:g} observations a frame (median), {_LEAST_OBSERVATIONS} are the least"
            return f"{self.log.robot}: too little to map: {seen}"
        if self.guessed > _MOST_GUESSED * n:
            lost = f"{self.guessed} of {n} motions could not be told from the pictures"
            return f"{self.log.robot}: too little to map: {lost}"
        return ""


class StereoImport:
    """One recording on its way into logs: its camera, and the settings of the front end.

    Args:
        recording: what was read.
        adjust: from settings that follow from the camera and what it sees to those to be used.
        calibration: from what is usually left open of a camera and its mount to what is of this.

    Raises:
        InputError: no camera can be made of the calibration, pictures have another size, or their
            rows do not fit.
    """

    def __init__(
        self,
        recording: StereoRecording,
        adjust: Vision = lambda vision: vision,
        calibration: Calibration = lambda usual: usual,
    ) -> None:
        self._recording = recording
        try:
            self._rectification = Rectification.of(recording.calibration)
        except InputError as error:
            raise InputError(f"{recording.calibrated_by or recording.name}: {error}") from error
        self.camera: StereoCamera = self._rectification.camera
        by_camera = self._vision_of_camera()
        self.calibration_error = calibration(usual_calibration(self.camera))
        pairs = [self.rectified(k) for k in sample_indices(len(recording))]
        self._require_rows(pairs, by_camera)
        middle = max((len(recording) - _RUN) // 2, 0)
        run = [self.rectified(k) for k in range(len(recording))[middle : middle + _RUN]]
        self.vision = adjust(front_end_for_recording(self.camera, pairs, run))
        turn = se3.pose(self._rectification.R_left_rectified, np.zeros(3))
        self.T_robot_camera: Float = recording.T_robot_left @ turn

    def _vision_of_camera(self) -> FrontEndParameters:
        """Derive front-end settings from the calibration; raises InputError that names it."""
        try:
            return front_end_for_camera(self.camera)
        except OutOfRangeError as error:
            told = self._recording.calibrated_by or self._recording.name
            pair = f"the baseline is {self.camera.baseline_m:g} m"
            pair += f" and the focal length {self.camera.focal_px:g} px"
            beyond = f"no setting fits such a pair ({error}); are they in metres and pixels?"
            raise InputError(f"{told}: {pair}; {beyond}") from error

    def rectified(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """The pair k of the recording, rectified; raises InputError."""
        raw = self._recording.pair(k)
        try:
            return self._rectification.apply(raw)
        except InputError as error:
            raise InputError(f"{self._recording.name}, pair {k}: {error}") from error

    def _require_rows(
        self, pairs: Sequence[tuple[np.ndarray, np.ndarray]], vision: FrontEndParameters
    ) -> None:
        off = np.concatenate([offsets(*pair, vision.harris) for pair in pairs])
        if len(off) < _LEAST_MATCHES:
            return
        rows = float(np.median(np.abs(off[:, 1])))
        if rows > _MOST_ROWS_OFF:
            found = f"points lie {rows:.1f} rows apart in the two images (median of {len(off)})"
            remedy = "the pair is not rectified, or its calibration is another's"
            raise InputError(f"{self._recording.name}: {found}; {remedy}")
        columns = float(np.median(off[:, 0]))
        if columns > _MOST_COLUMNS_AHEAD:
            found = f"points lie {columns:.1f} px farther right in the right image than in the left"
            remedy = "are the cameras the other way round?"
            raise InputError(f"{self._recording.name}: {found} (median of {len(off)}); {remedy}")

    def log_of(
        self,
        cut: RecordingPart,
        on_progress: OnProgress = lambda *_: None,
        level: AttitudeSource = "auto",
    ) -> Imported:
        """The log of one robot, with its truth; `level` is where its attitude is known from.

        Raises:
            InputError: fewer than two frames, or recorded odometry that lacks one of them.
        """
        rows = range(len(self._recording))[cut.rows]
        if len(rows) < 2:
            found = f"frames of {cut.robot} are {len(rows)} of {len(self._recording)} pairs"
            raise InputError(f"{self._recording.name}: {found}; 2 are the least")
        time_ns = self._recording.time_ns[rows]
        reckoned, T_world_robot = self._odometry(time_ns), self._truth(time_ns)
        truth = None if T_world_robot is None else se3.planar(T_world_robot)
        known = choose_attitude_source(level, reckoned, self._recording.inertial)
        if known == "odometry" and reckoned is None:
            raise InputError(f"--level odometry: {self._recording.name} has no odometry")
        tilts, counted = self._felt(time_ns) if known == "imu" else (None, None)
        usual_ns = np.median(np.diff(self._recording.time_ns))
        steps = np.diff(time_ns, prepend=time_ns[0]) / usual_ns
        front_end = FrontEnd(self.camera, self.vision)
        levels = AttitudeMeasurements(
            known, self.camera, self.T_robot_camera, reckoned, tilts, counted
        )
        frames = LevelledFrames(self.vision, levels)
        for n, k in enumerate(rows):
            frames.add(front_end.extract(*self.rectified(k)), float(steps[n]))
            on_progress(f"{cut.robot}: track features", n + 1, len(rows))
        time_s = (time_ns - self._recording.time_ns[0]) / 1e9
        attitude, linked = self._attitude(frames, known), np.array(frames.linked)
        seen = visual_odometry(frames.motions, steps, self.camera, self.T_robot_camera, attitude)
        odometry = seen.increments if reckoned is None else _increments(reckoned)
        observed = joined(frames.observed)
        log = RobotLog(cut.robot, False, time_s, odometry, *observed, self.calibration_error)
        shown = robot_motions(frames.motions, self.camera, self.T_robot_camera)
        findings = _findings(shown, reckoned, T_world_robot)
        if reckoned is not None:
            return Imported(log, truth, linked, attitude=attitude, findings=findings)
        told = seen.covariance, attitude, int(seen.guessed.sum())
        return Imported(log, truth, linked, *told, findings=findings)

    def _attitude(self, frames: LevelledFrames, known: AttitudeSource) -> Attitude | None:
        """By which the frames were levelled; raises InputError."""
        try:
            return frames.attitude
        except ValueError as error:
            reason = f"{error}; by --level {known} the robot's attitude is no robot's"
            raise InputError(f"{self._recording.name}: {reason}") from error

    def _felt(self, time_ns: np.ndarray) -> tuple[tuple[Float, Float], tuple[Float, Float] | None]:
        """Tilts by the accelerometer, and turns by the gyroscopes, as `Levels` has them."""
        felt, name = self._recording.inertial, self._recording.name
        if felt is None:
            raise InputError(f"--level imu: {name} has no accelerations that are read")
        try:
            tilts, turns = felt.tilts(time_ns), felt.turns(time_ns)
        except InputError as error:
            raise InputError(f"--level imu: {name}: {error}") from error
        return tilts, None if turns is None else (turns, np.diff(time_ns, prepend=time_ns[0]) / NS)

    def _odometry(self, time_ns: np.ndarray) -> Float | None:
        """Poses (T, 4, 4) at the frames, by the recorded dead reckoning; None without it."""
        recorded = self._recording.odometry
        if recorded is None:
            return None
        T = recorded.at(time_ns, _LONGEST_ODOMETRY_GAP_S)
        unknown = np.flatnonzero(np.isnan(T[:, 0, 0]))
        if len(unknown):
            if len(unknown) == len(T):
                raise InputError(f"{self._recording.name}: {_apart('odometry', recorded, time_ns)}")
            when = f"{(int(time_ns[unknown[0]]) - int(self._recording.time_ns[0])) / 1e9:g} s"
            missing = f"at {len(unknown)} of {len(T)} frames, the first {when} after the beginning"
            raise InputError(f"{self._recording.name}: no odometry {missing}")
        fallen = np.flatnonzero(T[:, 2, 2] <= 0)
        if len(fallen):
            found = f"by the odometry the robot stands on its head in frame {int(fallen[0])}"
            raise InputError(f"{self._recording.name}: {found}; is its quaternion x y z w?")
        return T

    def _truth(self, time_ns: np.ndarray) -> Float | None:
        """True poses (T, 4, 4) at the frames, NaN where unknown; raises InputError without any."""
        truth = self._recording.truth
        if truth is None:
            return None
        T = truth.at(time_ns, _LONGEST_TRUTH_GAP_S)
        if np.isnan(T[:, 0, 0]).all() and not _overlap(truth, self._recording.time_ns):
            raise InputError(f"{self._recording.name}: {_apart('truth', truth, time_ns)}")
        return T


def _overlap(poses: TimedPoses, time_ns: np.ndarray) -> bool:
    """Return True if any time of the poses lies within the times of a recording."""
    return bool(len(poses.time_ns)) and bool(
        poses.time_ns[0] <= time_ns[-1] and time_ns[0] <= poses.time_ns[-1]
    )


def _apart(what: str, poses: TimedPoses, time_ns: np.ndarray) -> str:
    """Words for poses that lie at other times than frames."""
    if not len(poses.time_ns):
        return f"the {what} holds no pose"
    spans = [
        f"{int(times[0]) / NS:.3f} to {int(times[-1]) / NS:.3f} s"
        for times in (poses.time_ns, time_ns)
    ]
    reason = f"the {what} is of {spans[0]}, the pictures are of {spans[1]}"
    return f"{reason}: it has no pose at any of them; is it another recording's, or another clock?"


def _findings(
    shown: Sequence[RigidMotion | None],
    reckoned: Float | None,
    T_world_robot: Float | None,
) -> tuple[Finding, ...]:
    """Return findings about odometry and truth (T, 4, 4) that contradict the pictures' motions."""
    known = [(k, motion) for k, motion in enumerate(shown) if k and motion is not None]
    spans = composed_spans(motions_between_frames(known), len(shown))
    found = []
    if reckoned is not None:
        what = "the odometry contradicts the motion that the pictures show"
        given = Stated(reckoned, MotionNoise()), pose_mistakes(reckoned)
        found.append(disagreement("odometry", what, spans, *given))
    if T_world_robot is not None and np.isnan(T_world_robot[:, 0, 0]).all():
        gap = f"over gaps longer than {_LONGEST_TRUTH_GAP_S:g} s it is not interpolated"
        found.append(Finding("truth", -1, f"the truth is known at none of the frames: {gap}"))
    elif T_world_robot is not None:
        reference = "the motion that the pictures show"
        found.append(truth_finding(reference, spans, T_world_robot))
    return tuple(one for one in found if one is not None)


def _increments(T_start_robot: Float) -> Float:
    """Motions (T, 3) between the poses (T, 4, 4) in the plane; the first is zero."""
    increments = np.zeros((len(T_start_robot), 3))
    planar = se3.from_planar(se3.planar(T_start_robot))
    increments[1:] = se3.planar(se3.between(planar[:-1], planar[1:]))
    return increments


def write_imported(destination: Path, imported: Sequence[Imported]) -> list[Path]:
    """Write the logs, with the truth beside them, to folders named by robot; returns these."""
    folders = [destination / one.log.robot for one in imported]
    for folder, one in zip(folders, imported, strict=True):
        write_log(folder, one.log)
        for outdated in TRUTH_FILES:  # of an import into the same folder
            (folder / outdated).unlink(missing_ok=True)
        write_odometry_covariance(folder, one.odometry_covariance)
        write_attitude(folder, one.attitude)
        if one.truth is not None:
            write_truth_poses(folder, one.truth)
    return folders
