"""Import of stereo recordings: rectification, tracking, levelling, robot logs.

The defaults of `FrontEndParameters` are lengths in metres for one stereo head. They stand for
disparities and shares of the image and are converted for other cameras. Further settings are
estimated from the pictures of the recording: depths, stereo noise (`stereo_noise.py`), number of
corners, and reprojection errors from frame to frame.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapfusion.attitude import Attitude, write_attitude
from mapfusion.camera import CalibrationError, StereoCamera, default_calibration_error
from mapfusion.datasets.camera_calibration import Rectification
from mapfusion.datasets.formats import AttitudeSource
from mapfusion.datasets.levelling import (
    AttitudeMeasurements,
    LevelledFrames,
    choose_attitude_source,
)
from mapfusion.datasets.log_consistency import Finding, disagreement, truth_finding
from mapfusion.datasets.motion_agreement import ReportedMotions, pose_mistakes
from mapfusion.datasets.relative_motion import composed_spans, motions_between_frames
from mapfusion.datasets.stereo_recording import StereoRecording, sample_indices
from mapfusion.datasets.text_files import NS, TimedPoses
from mapfusion.errors import InputError, OutOfRangeError
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float
from mapfusion.robot_log import (
    TRUTH_FILES,
    RobotLog,
    write_log,
    write_odometry_covariance,
    write_truth_poses,
)
from mapfusion.vision.depth import DepthParameters
from mapfusion.vision.front_end import (
    FrontEnd,
    FrontEndParameters,
    Observer,
    concatenate_observations,
)
from mapfusion.vision.stereo_noise import (
    estimate_noise,
    parameters_for_noise,
    rectification_offsets,
)
from mapfusion.vision.tracking import Tracks
from mapfusion.vision.visual_odometry import RigidMotion, robot_motions, visual_odometry

Pair = tuple[np.ndarray, np.ndarray]

_DEFAULT_CAMERA = StereoCamera()  # the stereo head of the default settings
_DEFAULT_DEPTH_M = 3.5  # median distance of walls from robots with this head
# Ratio of step length to depth, relative to robots that see walls at 3.5 m in steps of 0.1 m. The
# ratio of a car (1.2 m at a median depth of 21 m) is twice as large, and four times as large for
# the nearer half of the visible points.
_STEP_RATIO = 4.0
_AREA_PX = 300  # of the image per corner: textured corners keep a distance of 10 px
_MAX_CORNERS = 5000  # limit of the setting
# Share of true surface points that pass all stereo checks. A larger share admits more points near
# edges, whose two views differ by more than noise.
_TRUE_SHARE = 0.8
_MAX_OBSERVATIONS = 100  # of a frame; the time of a filter step is proportional to their number
_MEDIAN_ERROR = 0.6745  # median absolute error of a normal variable, in standard deviations
_SIDE_M = (0.01, 10.0)  # limits of the setting for the descriptor window
# The search window for rows is 17 px high, so features with an offset of one row are still found.
# An offset of two rows loses half of the matches.
_MAX_ROW_OFFSET = 1.0
_MAX_NEGATIVE_DISPARITY = 2.0  # distant points have no disparity, up to calibration errors
_RUN = 8  # number of consecutive pairs for estimates from tracks
_MIN_MATCHES = 20  # for a reliable median of the row offsets
_LONGEST_ODOMETRY_GAP_S = 1.0  # of interpolation: wheel odometry is frequent and smooth
_LONGEST_TRUTH_GAP_S = 0.1  # of interpolation, as for MRCLAM
_MIN_OBSERVATIONS = 4  # of a frame; three determine a motion
_MAX_EXTRAPOLATED = 0.1  # share of all motions

OnProgress = Callable[[str, int, int], None]
Vision = Callable[[FrontEndParameters], FrontEndParameters]
Calibration = Callable[[CalibrationError], CalibrationError]


def front_end_for_camera(camera: StereoCamera) -> FrontEndParameters:
    """Return settings scaled to a camera: depths by disparity, shifts and corners by image size."""
    usual = FrontEndParameters()
    scale = (
        camera.focal_px
        * camera.baseline_m
        / (_DEFAULT_CAMERA.focal_px * _DEFAULT_CAMERA.baseline_m)
    )
    wide, high = (
        camera.width_px / _DEFAULT_CAMERA.width_px,
        camera.height_px / _DEFAULT_CAMERA.height_px,
    )
    corners = camera.width_px * camera.height_px // _AREA_PX
    stereo = replace(
        usual.stereo,
        min_depth_m=usual.stereo.min_depth_m * scale / max(wide, 1.0),
        max_depth_m=usual.stereo.max_depth_m * scale,
        nearest_plane_m=usual.stereo.nearest_plane_m
        * camera.baseline_m
        / _DEFAULT_CAMERA.baseline_m,
    )
    tracks = replace(
        usual.tracks,
        max_shift_u_px=usual.tracks.max_shift_u_px * wide,
        max_shift_v_px=usual.tracks.max_shift_v_px * _STEP_RATIO * high,
        max_disparity_ratio=usual.tracks.max_disparity_ratio**_STEP_RATIO,
    )
    return replace(
        usual,
        harris=replace(usual.harris, max_corners=min(max(corners, 1), _MAX_CORNERS)),
        stereo=stereo,
        tracks=tracks,
        max_depth_m=usual.max_depth_m * scale,
        max_sigma_depth_m=usual.max_sigma_depth_m * scale,
    )


def front_end_for_recording(
    camera: StereoCamera,
    samples: Sequence[Pair],
    run: Sequence[Pair],
    depth: DepthParameters | None = None,
) -> FrontEndParameters:
    """Return settings for a camera and the pictures of a recording.

    Args:
        camera: the rectified pair.
        samples: pairs (H, W) uint8 from the whole recording.
        run: consecutive pairs, for estimates from tracks.
        depth: noise and tests of depth images; None for stereo pairs.
    """
    vision, noise = front_end_for_camera(camera), None
    if depth is None:
        noise = estimate_noise(samples, camera, vision.harris, vision.stereo)
    else:  # the noise of a depth does not depend on the focal length of the camera
        usual = FrontEndParameters()
        limits = {"max_depth_m": usual.max_depth_m, "max_sigma_depth_m": usual.max_sigma_depth_m}
        vision = replace(vision, **limits)
    if noise is not None:
        stereo = parameters_for_noise(vision.stereo, noise, _TRUE_SHARE)
        tracks = replace(
            vision.tracks,
            noise_grey=noise.noise_grey,
            max_misfit_px=max(vision.tracks.max_misfit_px, noise.misfit_px),
        )
        vision = replace(vision, stereo=stereo, tracks=tracks)
    front_end = FrontEnd(camera, vision, depth)
    depth_m = [
        camera.focal_px * camera.baseline_m / front_end.extract(*pair).disparity_px
        for pair in samples
    ]
    vision = scale_descriptor_window(vision, camera, np.concatenate([*depth_m, np.empty(0)]))
    front_end = FrontEnd(camera, vision, depth)
    frames = [front_end.extract(*pair) for pair in run]

    # The pixel noise follows from reprojection errors, the number of corners from observations.
    observer = Observer.of(camera, vision)
    seen = [observer.observe(found).tracks for found in frames]
    errors = [
        reprojection_errors_px(camera, before, after)
        for before, after in itertools.pairwise(seen)
        if after.motion is not None
    ]
    if errors:
        # Both frames contribute to an error.
        sigma_px = float(np.median(np.abs(np.concatenate(errors)))) / _MEDIAN_ERROR / np.sqrt(2)
        vision = replace(vision, sigma_uv_px=float(max(vision.sigma_uv_px, sigma_px)))
    observer = Observer.of(camera, vision)
    lasting = [len(observer.observe(found).rows) for found in frames]
    usual = np.median(lasting[vision.tracks.min_length - 1 :] or [0])
    if usual > _MAX_OBSERVATIONS:
        corners = int(vision.harris.max_corners * _MAX_OBSERVATIONS / usual)
        vision = replace(vision, harris=replace(vision.harris, max_corners=corners))
    return vision


def scale_descriptor_window(
    vision: FrontEndParameters, camera: StereoCamera, depth_m: Float
) -> FrontEndParameters:
    """Scale the descriptor window to observed depths (N,); no depths leave it unchanged.

    The factor is a power of two, so that similar robots in similar places use the same window and
    their descriptors can be compared.
    """
    if not len(depth_m):
        return vision
    usual_m = vision.usurf.side_m
    fits = np.median(depth_m) / _DEFAULT_DEPTH_M * _DEFAULT_CAMERA.focal_px / camera.focal_px
    side_m = usual_m * 2.0 ** float(np.round(np.log2(fits)))
    return replace(vision, usurf=replace(vision.usurf, side_m=float(np.clip(side_m, *_SIDE_M))))


def reprojection_errors_px(
    camera: StereoCamera, tracks_before: Tracks, tracks_after: Tracks
) -> Float:
    """Return reprojection errors of tracked points after the motion, u and v, shape (2N,).

    The motion of the frame `tracks_after` must be known.
    """
    assert tracks_after.motion is not None
    _, old, new = np.intersect1d(tracks_before.track_id, tracks_after.track_id, return_indices=True)
    p_after, _ = camera.triangulate(
        tracks_after.uv_px[new], tracks_after.disparity_px[new], 1.0, 1.0
    )
    T = tracks_after.motion.T_before_after
    moved = camera.project(p_after @ T[:3, :3].T + T[:3, 3])
    return (moved[:, :2] - tracks_before.uv_px[old]).ravel()


@dataclass(frozen=True)
class RecordingPart:
    """Part of a recording that becomes the log of one robot.

    Attributes:
        robot: name of the robot.
        rows: pairs of the recording.
    """

    robot: str
    rows: slice


@dataclass(frozen=True)
class Imported:
    """Import of one robot's frames.

    Attributes:
        log: the robot log.
        truth: T_world_robot, shape (T, 3), or None.
        linked: share of the features of the frame before that were found again, shape (T,); NaN
            for the first frame.
        odometry_covariance: covariance of visual odometry, shape (T, 3, 3); None for recorded
            odometry.
        attitude: attitude for levelling the observations; None for a level body.
        guessed: number of frames whose motion was extrapolated because too few features matched.
        findings: contradictions of recorded odometry and truth.
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
        """Number of observations of each frame, shape (T,)."""
        return np.diff(self.log.frame_starts())

    @property
    def too_little(self) -> str:
        """Reason why the log cannot be mapped; empty if it can."""
        usual, n = float(np.median(self.observations)), len(self.log)
        if usual < _MIN_OBSERVATIONS:
            seen = f"{usual:g} observations a frame (median), {_MIN_OBSERVATIONS} are the least"
            return f"{self.log.robot}: too little to map: {seen}"
        if self.guessed > _MAX_EXTRAPOLATED * n:
            message = f"{self.guessed} of {n} motions could not be told from the pictures"
            return f"{self.log.robot}: too little to map: {message}"
        return ""


class StereoImport:
    """Import of one recording, with its rectified camera and front-end settings.

    Args:
        recording: recording that was read.
        adjust: function that changes the settings that were derived from camera and pictures.
        calibration: function that changes the usual calibration error of camera and mount.

    Raises:
        InputError: the calibration cannot be rectified, pictures have another size, or their rows
            do not fit.
    """

    def __init__(
        self,
        recording: StereoRecording,
        adjust: Vision = lambda vision: vision,
        calibration: Calibration = lambda usual: usual,
    ) -> None:
        self._recording = recording
        calibrated_by = recording.calibrated_by or recording.name
        try:
            self._rectification = Rectification.of(recording.calibration)
        except InputError as error:
            raise InputError(f"{calibrated_by}: {error}") from error
        self.camera: StereoCamera = self._rectification.camera
        try:
            scaled = front_end_for_camera(self.camera)
        except OutOfRangeError as error:
            pair = f"the baseline is {self.camera.baseline_m:g} m"
            pair += f" and the focal length {self.camera.focal_px:g} px"
            beyond = f"no setting fits such a pair ({error}); are they in metres and pixels?"
            raise InputError(f"{calibrated_by}: {pair}; {beyond}") from error
        self.calibration_error = calibration(default_calibration_error(self.camera))
        samples = [self.rectified(k) for k in sample_indices(len(recording))]
        if recording.depth is None:
            self._require_row_alignment(samples, scaled)
        middle = max((len(recording) - _RUN) // 2, 0)
        run = [self.rectified(k) for k in range(len(recording))[middle : middle + _RUN]]
        derived = front_end_for_recording(self.camera, samples, run, recording.depth)
        self.vision = adjust(derived)
        turn = se3.pose(self._rectification.R_left_rectified, np.zeros(3))
        self.T_robot_camera: Float = recording.T_robot_left @ turn

    def rectified(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rectified pair k of the recording; raise InputError for another size."""
        raw = self._recording.pair(k)
        try:
            return self._rectification.apply(raw)
        except InputError as error:
            raise InputError(f"{self._recording.name}, pair {k}: {error}") from error

    def _require_row_alignment(self, pairs: Sequence[Pair], vision: FrontEndParameters) -> None:
        """Raise InputError if matched corners have a row offset or a negative disparity."""
        offsets = np.concatenate([rectification_offsets(*pair, vision.harris) for pair in pairs])
        if len(offsets) < _MIN_MATCHES:
            return
        rows = float(np.median(np.abs(offsets[:, 1])))
        if rows > _MAX_ROW_OFFSET:
            problem = (
                f"points lie {rows:.1f} rows apart in the two images (median of {len(offsets)})"
            )
            remedy = "the pair is not rectified, or its calibration is another's"
            raise InputError(f"{self._recording.name}: {problem}; {remedy}")
        columns = float(np.median(offsets[:, 0]))
        if columns > _MAX_NEGATIVE_DISPARITY:
            problem = (
                f"points lie {columns:.1f} px farther right in the right image than in the left"
            )
            remedy = "are the cameras the other way round?"
            raise InputError(
                f"{self._recording.name}: {problem} (median of {len(offsets)}); {remedy}"
            )

    def log_of(
        self,
        part: RecordingPart,
        on_progress: OnProgress = lambda *_: None,
        level: AttitudeSource = "auto",
    ) -> Imported:
        """Make the log of one robot, with its truth.

        Args:
            part: part of the recording.
            on_progress: called with a text, the number of processed frames and that of all frames.
            level: source of the attitude.

        Raises:
            InputError: the part has fewer than two frames, or recorded odometry lacks a frame.
        """
        recording, name = self._recording, self._recording.name
        rows = range(len(recording))[part.rows]
        if len(rows) < 2:
            frames_text = f"frames of {part.robot} are {len(rows)} of {len(recording)} pairs"
            raise InputError(f"{name}: {frames_text}; 2 are the least")
        time_ns = recording.time_ns[rows]
        reckoned, T_world_robot = self._odometry_at(time_ns), self._truth_at(time_ns)

        # Measurements of the attitude.
        source = choose_attitude_source(level, reckoned, recording.inertial)
        if source == "odometry" and reckoned is None:
            raise InputError(f"--level odometry: {name} has no odometry")
        tilts, turns = None, None
        if source == "imu":
            if recording.inertial is None:
                raise InputError(f"--level imu: {name} has no accelerations that are read")
            try:
                tilts = recording.inertial.tilts(time_ns)
                turns = recording.inertial.turns(time_ns)
            except InputError as error:
                raise InputError(f"--level imu: {name}: {error}") from error
        rotations = None if turns is None else (turns, np.diff(time_ns, prepend=time_ns[0]) / NS)
        measurements = AttitudeMeasurements(
            source, self.camera, self.T_robot_camera, reckoned, tilts, rotations
        )

        # Features, tracks and levelled observations of each frame.
        usual_ns = np.median(np.diff(recording.time_ns))
        steps = np.diff(time_ns, prepend=time_ns[0]) / usual_ns
        front_end = FrontEnd(self.camera, self.vision, recording.depth)
        frames = LevelledFrames(self.vision, measurements)
        for n, k in enumerate(rows):
            frames.add(front_end.extract(*self.rectified(k)), float(steps[n]))
            on_progress(f"{part.robot}: track features", n + 1, len(rows))
        try:
            attitude = frames.attitude
        except ValueError as error:
            reason = f"{error}; by --level {source} the robot's attitude is no robot's"
            raise InputError(f"{name}: {reason}") from error

        # Odometry: recorded, or visual odometry without it.
        seen = visual_odometry(frames.motions, steps, self.camera, self.T_robot_camera, attitude)
        odometry = seen.increments
        if reckoned is not None:
            planar = se3.from_planar(se3.planar(reckoned))
            odometry = np.zeros((len(reckoned), 3))
            odometry[1:] = se3.planar(se3.between(planar[:-1], planar[1:]))
        time_s = (time_ns - self._recording.time_ns[0]) / 1e9
        observed = concatenate_observations(frames.observed)
        log = RobotLog(part.robot, False, time_s, odometry, *observed, self.calibration_error)
        motions = robot_motions(frames.motions, self.camera, self.T_robot_camera)
        return Imported(
            log,
            None if T_world_robot is None else se3.planar(T_world_robot),
            np.array(frames.linked),
            seen.covariance if reckoned is None else None,
            attitude,
            int(seen.guessed.sum()) if reckoned is None else 0,
            _find_contradictions(motions, reckoned, T_world_robot),
        )

    def _odometry_at(self, time_ns: np.ndarray) -> Float | None:
        """Return dead-reckoned poses (T, 4, 4) at the frames; None without recorded odometry."""
        recorded = self._recording.odometry
        if recorded is None:
            return None
        T = recorded.at(time_ns, _LONGEST_ODOMETRY_GAP_S)
        unknown = np.flatnonzero(np.isnan(T[:, 0, 0]))
        if len(unknown):
            if len(unknown) == len(T):
                spans = _time_spans_text("odometry", recorded, time_ns)
                raise InputError(f"{self._recording.name}: {spans}")
            when = f"{(int(time_ns[unknown[0]]) - int(self._recording.time_ns[0])) / 1e9:g} s"
            missing = f"at {len(unknown)} of {len(T)} frames, the first {when} after the beginning"
            raise InputError(f"{self._recording.name}: no odometry {missing}")
        fallen = np.flatnonzero(T[:, 2, 2] <= 0)
        if len(fallen):
            problem = f"by the odometry the robot stands on its head in frame {int(fallen[0])}"
            raise InputError(f"{self._recording.name}: {problem}; is its quaternion x y z w?")
        return T

    def _truth_at(self, time_ns: np.ndarray) -> Float | None:
        """Return true poses (T, 4, 4) at the frames, NaN where unknown; None without truth.

        Raises:
            InputError: the truth is of another time than the recording.
        """
        truth = self._recording.truth
        if truth is None:
            return None
        T = truth.at(time_ns, _LONGEST_TRUTH_GAP_S)
        times, truth_times = self._recording.time_ns, truth.time_ns
        overlap = len(truth_times) and truth_times[0] <= times[-1] and times[0] <= truth_times[-1]
        if np.isnan(T[:, 0, 0]).all() and not overlap:
            spans = _time_spans_text("truth", truth, time_ns)
            raise InputError(f"{self._recording.name}: {spans}")
        return T


def _time_spans_text(what: str, poses: TimedPoses, time_ns: np.ndarray) -> str:
    """Return a message about poses and frames whose times do not overlap."""
    if not len(poses.time_ns):
        return f"the {what} holds no pose"
    spans = [
        f"{int(times[0]) / NS:.3f} to {int(times[-1]) / NS:.3f} s"
        for times in (poses.time_ns, time_ns)
    ]
    reason = f"the {what} is of {spans[0]}, the pictures are of {spans[1]}"
    return f"{reason}: it has no pose at any of them; is it another recording's, or another clock?"


def _find_contradictions(
    motions: Sequence[RigidMotion | None],
    reckoned: Float | None,
    T_world_robot: Float | None,
) -> tuple[Finding, ...]:
    """Return findings about odometry and truth (T, 4, 4) that contradict the visual motions."""
    known_motions = [(k, motion) for k, motion in enumerate(motions) if k and motion is not None]
    spans = composed_spans(motions_between_frames(known_motions), len(motions))
    findings = []
    if reckoned is not None:
        subject = "the odometry contradicts the motion that the pictures show"
        reported = ReportedMotions(reckoned, MotionNoise())
        findings.append(disagreement("odometry", subject, spans, reported, pose_mistakes(reckoned)))
    if T_world_robot is not None and np.isnan(T_world_robot[:, 0, 0]).all():
        gap = f"over gaps longer than {_LONGEST_TRUTH_GAP_S:g} s it is not interpolated"
        findings.append(Finding("truth", -1, f"the truth is known at none of the frames: {gap}"))
    elif T_world_robot is not None:
        reference = "the motion that the pictures show"
        findings.append(truth_finding(reference, spans, T_world_robot))
    return tuple(one for one in findings if one is not None)


def write_imported(destination: Path, imported: Sequence[Imported]) -> list[Path]:
    """Write logs and their truth to folders named by robot and return the folders."""
    folders = [destination / one.log.robot for one in imported]
    for folder, one in zip(folders, imported, strict=True):
        write_log(folder, one.log)
        for outdated in TRUTH_FILES:  # of an earlier import into the same folder
            (folder / outdated).unlink(missing_ok=True)
        write_odometry_covariance(folder, one.odometry_covariance)
        write_attitude(folder, one.attitude)
        if one.truth is not None:
            write_truth_poses(folder, one.truth)
    return folders
