"""Robot of a team: filters its log, exchanges maps and goes on in the joint map.

A robot sends the smoothed map of its own log. So no information reaches a robot twice, whatever
is exchanged how often. At each exchange the robot aligns all maps that it has, verifies the
alignments, and fuses the maps that the accepted alignments connect with its own. Its filter then
goes on in the fused map (`adoption`).

An alignment is on trial until it is accepted at a second exchange, when the robots have seen more.
A map is dropped when its alignment is not accepted at two exchanges in succession.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from mapfusion.align.alignment import Alignment
from mapfusion.align.correspondences import Correspondences, MatchParameters, match
from mapfusion.attitude import Attitude
from mapfusion.fastslam.filter import FastSlam, FastSlamParameters
from mapfusion.fastslam.mapping import Frame, run_log
from mapfusion.fusion.fusers import AlignedPair, FusedMap, Fuser, MergeParameters, name_order
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.fusion.merge import merge
from mapfusion.geometry.numerics import Float, generator
from mapfusion.geometry.se2 import rms_distance_m
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog, first_frames
from mapfusion.smoother.smooth import Smoothed, SmootherParameters, smooth, smoothed_map
from mapfusion.team.adoption import ADOPTED, TimedMap, prior_of
from mapfusion.team.map_message import CompactMap, MapMessage
from mapfusion.verification.registration import Registration
from mapfusion.verification.rivals import DISTINCT_M

# Most maps that a sender keeps for a receiver that does not confirm them.
_MOST_UNRECEIVED = 16


class Event(NamedTuple):
    """Change of what a robot has adopted.

    Attributes:
        iteration: number of the frame.
        robot: name of the robot.
        other: name of the robot whose map it is.
        kind: `on trial`, `adopted`, `kept` (not accepted this time) or `dropped`; `not smoothed` if
            the robot's own log cannot be smoothed, so that it neither sends nor merges.
        T_robot_other: pose of the other map in that of the robot, shape (3,); NaN if unknown.
        covariance: covariance of this pose, shape (3, 3).
        reason: reason of the verdict or of the failure; empty if there is none.
    """

    iteration: int
    robot: str
    other: str
    kind: str
    T_robot_other: Float
    covariance: Float
    reason: str


@dataclass(frozen=True)
class Merging:
    """Methods by which the robots of a team merge their maps.

    Attributes:
        registration: aligner, refinement and verdict.
        matching: parameters of the matching.
        fuser: fuses smoothed maps.
        parameters: parameters of the fusion.
    """

    registration: Registration
    fuser: Fuser
    matching: MatchParameters = field(default_factory=MatchParameters)
    parameters: MergeParameters = field(default_factory=MergeParameters)


@dataclass(frozen=True)
class RobotInput:
    """Log of a robot with the settings of its filter and smoother.

    Attributes:
        log: the log, without errors that a check of logs corrects.
        filter: settings of the filter.
        smoother: settings of the smoother.
        min_count: number of observations that a landmark of the map needs.
        odometry_covariance: covariance of visual odometry, shape (T, 3, 3); None for wheels.
        attitude: attitude that levelled the observations; None for a level robot.
        max_memory_gb: smoothing that may take more memory is refused.
        start: frame of the team in which the log starts; later than 0 for a robot that joins later.
        predecessor: name of the log that the robot recorded before it was carried elsewhere and its
            odometry was reset; empty for none. The robot knows all maps that it knew then, starts
            when that log ends, and looks for itself in them.
    """

    log: RobotLog
    filter: FastSlamParameters
    smoother: SmootherParameters
    min_count: int = 3
    odometry_covariance: Float | None = None
    attitude: Attitude | None = None
    max_memory_gb: float = np.inf
    start: int = 0
    predecessor: str = ""


class _Aligned(NamedTuple):
    """Verified alignment of two maps, with the numbers of these maps.

    `is_confirmed` is true if an alignment of earlier maps was accepted, too, and agrees.
    `T_accepted` is the motion that was last accepted, at this exchange or the one before; None if
    there is none.
    """

    versions: tuple[int, int]
    alignment: Alignment
    correspondences: Correspondences
    log10_false_alarms: float
    is_confirmed: bool
    T_accepted: Float | None = None


class Origin(NamedTuple):
    """Observation that created a landmark.

    Attributes:
        robot: name of the robot.
        row: row of its log.
    """

    robot: str
    row: int


class TeamRobot:
    """Robot of a team.

    Args:
        given: its log and settings.
        merging: methods of the team.
        seed: seed of the filter and the aligner; an independent robot of this seed has the same
            random numbers.
    """

    def __init__(self, given: RobotInput, merging: Merging, seed: int) -> None:
        self.given, self.name = given, given.log.robot
        self._merging, self._seed = merging, seed
        rng = generator(seed, "slam", self.name)
        covariance = given.odometry_covariance
        self._frames: Iterator[Frame] = run_log(
            given.log, given.filter, rng, (), given.min_count, covariance, given.attitude
        )
        self.frame: Frame | None = None
        self.own: TimedMap | None = None
        self.fused: FusedMap | None = None
        self.adopted: tuple[str, ...] = ()
        self.origins: dict[int, Origin] = {}
        self._shared = frozenset[int]()
        self._version = 0
        self._smoothed: Smoothed | None = None
        self._compact: CompactMap | None = None
        self._received: dict[str, tuple[int, CompactMap]] = {}
        # Maps that a sender may still build messages on, by version.
        self._bases: dict[str, dict[int, CompactMap]] = {}
        self._timed: dict[str, tuple[int, TimedMap]] = {}
        self._acknowledged: dict[str, tuple[int, CompactMap]] = {}
        self._sent: dict[str, dict[int, CompactMap]] = {}
        self._aligned: dict[tuple[str, str], _Aligned] = {}
        self._missed: set[str] = set()
        self._on_trial: set[str] = set()
        self._not_smoothed = ""

    @property
    def iteration(self) -> int:
        """Number of the last frame; -1 before the first."""
        return -1 if self.frame is None else self.frame.iteration

    @property
    def filter(self) -> FastSlam:
        """The filter after the last frame."""
        assert self.frame is not None
        return self.frame.slam

    @property
    def has_ended(self) -> bool:
        """True if the log has no more frames."""
        return self.iteration == len(self.given.log) - 1

    @property
    def is_lost(self) -> bool:
        """True if the robot was carried elsewhere and has not found itself in any map."""
        return bool(self.given.predecessor) and not self.adopted

    def inherit(self, predecessor: "TeamRobot") -> None:
        """Take over the maps that the robot knew before it was carried elsewhere."""
        self._received = dict(predecessor._received)
        if predecessor._compact is not None:
            self._received[predecessor.name] = predecessor._version, predecessor._compact

    def n_shared_now(self) -> int:
        """Return the number of observations in the last frame of landmarks that others mapped."""
        sources = self.filter.last_associations()
        return sum(source in self._shared for source in sources.tolist())

    def step(self) -> Frame:
        """Filter the next frame of the log."""
        self.frame = next(self._frames)
        return self.frame

    def smooth(self) -> None:
        """Smooth the log so far; if that fails, `merge` tells the reason."""
        given = self.given
        if self.own is not None and self.own.n_frames == self.iteration + 1:
            return  # nothing is new
        self._not_smoothed = ""
        log = first_frames(given.log, self.iteration + 1)
        if floor_m := given.filter.noise_floor_m:
            wider_m2 = log.observations.covariance_m2 + floor_m**2 * np.eye(3)
            log = replace(log, observations=replace(log.observations, covariance_m2=wider_m2))
        landmark = _as_rows(self.filter.best_associations())
        try:
            path = self.filter.best_path()
            smoothed = smooth(log, landmark, path, given.smoother, given.max_memory_gb)
            landmarks = smoothed_map(log, smoothed, attitude=given.attitude)
        except (np.linalg.LinAlgError, MemoryError) as error:
            self._not_smoothed = f"smoothing fails: {error}"
            return
        if not len(landmarks):
            return
        self._smoothed, self._version = smoothed, self._version + 1
        self.own = TimedMap.of(log, smoothed, landmarks)
        self._compact = CompactMap.of(self.own)

    def message_to(self, receiver: str) -> MapMessage | None:
        """Return a message with what the receiver lacks; None without a map."""
        if self._compact is None:
            return None
        version, known = self._acknowledged.get(receiver, (0, None))
        message = MapMessage.between(known, self._compact, (version, self._version))
        sent = self._sent.setdefault(receiver, {})
        sent[self._version] = message.applied_to(known)
        if len(sent) > _MOST_UNRECEIVED:
            del sent[min(sent)]
        return message.with_receipts({name: n for name, (n, _) in self._received.items()})

    def receive(self, sender: str, message: MapMessage) -> None:
        """Take a message; one that builds on a map which the robot lacks is ignored."""
        receipt = message.received.get(self.name, 0)
        sent = self._sent.get(sender, {})
        if receipt in sent:
            self._acknowledged[sender] = receipt, sent[receipt]
            self._sent[sender] = {n: each for n, each in sent.items() if n > receipt}
        version, _ = self._received.get(sender, (0, None))
        bases = self._bases.get(sender, {})
        if message.version <= version or (message.base and message.base not in bases):
            return
        found = message.applied_to(bases.get(message.base))
        self._received[sender] = message.version, found
        kept = {n: each for n, each in bases.items() if n >= message.base}
        self._bases[sender] = kept | {message.version: found}

    def merge(self) -> list[Event]:
        """Align and fuse the maps that the robot has; go on in the fused map."""
        if self._not_smoothed:
            nothing = np.full(3, np.nan), np.full((3, 3), np.nan)
            own = self.iteration, self.name, self.name, "not smoothed"
            return [Event(*own, *nothing, self._not_smoothed)]
        if self.own is None or self.own.n_frames <= self.iteration:  # no landmarks
            return []
        names = [self.name, *sorted(self._received, key=name_order)]
        maps = [self.own, *(self._timed_map(name) for name in names[1:])]
        versions = [self._version, *(self._received[name][0] for name in names[1:])]
        pairs = []
        for a, b in itertools.combinations(range(len(maps)), 2):
            both, of_both = (names[a], names[b]), (versions[a], versions[b])
            if both not in self._aligned or self._aligned[both].versions != of_both:
                given = maps[a].landmarks, maps[b].landmarks
                self._aligned[both] = self._align(both, given, of_both)
            known = self._aligned[both]
            if known.alignment.ok and known.is_confirmed:
                rest = known.alignment, known.correspondences, known.log10_false_alarms
                pairs.append(AlignedPair(a, b, *rest))
        component = None
        if any(pair.a == 0 for pair in pairs):
            landmarks = [each.landmarks for each in maps]
            merging = self._merging
            fusion = merge(landmarks, pairs, merging.parameters, merging.fuser)
            component = next((each for each in fusion.fused if each.members[0] == 0), None)
        members = (0,) if component is None else tuple(component.members.tolist())
        found = {names[k] for k in members[1:]}
        missing = set(self.adopted) - found
        kept = missing - self._missed
        self._missed = missing if kept else set()
        if kept:  # the filter stays in the map that it has
            return self._events(dict.fromkeys(kept, "kept"))
        kinds = dict.fromkeys(found - set(self.adopted), "adopted")
        events = self._events(kinds | dict.fromkeys(missing, "dropped"), component, names)
        if not found and not missing:
            return events
        if component is None:
            component = _alone(self.own.landmarks)
        self._adopt(component, names, maps)
        self.adopted = tuple(sorted(found, key=name_order))
        return events

    def _timed_map(self, name: str) -> TimedMap:
        """Return the last map from another robot."""
        version, compact = self._received[name]
        if name not in self._timed or self._timed[name][0] != version:
            self._timed[name] = version, compact.timed()
        return self._timed[name][1]

    def _align(
        self,
        names: tuple[str, str],
        maps: tuple[LandmarkMap, LandmarkMap],
        versions: tuple[int, int],
    ) -> _Aligned:
        """Align two maps and verify the alignment."""
        merging, before = self._merging, self._aligned.get(names)
        pairs = match(*maps, merging.matching)
        rng = generator(self._seed, "team", self.name, *names, self.iteration)
        registered = merging.registration.register(*maps, pairs, rng)
        alignment = registered.applied
        agrees, T_accepted = False, alignment.T_a_b if alignment.ok else None
        if alignment.ok and before is not None and before.T_accepted is not None:
            p_b = maps[1].position_m[:, :2]
            distance_m = rms_distance_m(alignment.T_a_b, before.T_accepted, p_b)
            agrees = distance_m < DISTINCT_M
        elif not alignment.ok and before is not None and before.alignment.ok:
            T_accepted = before.T_accepted
        log10 = registered.verdict.log10_false_alarms
        return _Aligned(versions, alignment, pairs, log10, agrees, T_accepted)

    def _events(
        self, kinds: dict[str, str], fused: FusedMap | None = None, names: Sequence[str] = ()
    ) -> list[Event]:
        """Return what changes at this exchange: kinds of change by robot, and new trials."""
        on_trial = set[str]()
        for a, b in self._aligned:
            known = self._aligned[a, b]
            is_new = b not in kinds and b not in self.adopted
            if a == self.name and is_new and known.alignment.ok and not known.is_confirmed:
                on_trial.add(b)
        kinds |= dict.fromkeys(on_trial - self._on_trial, "on trial")
        self._on_trial = on_trial
        events = []
        for name in sorted(kinds, key=name_order):
            alignment = self._aligned[self.name, name].alignment
            T, covariance, reason = alignment.T_a_b, alignment.covariance, alignment.reason
            if kinds[name] == "adopted" and fused is not None:  # perhaps by way of another robot
                k, reason = names.index(name), reason if alignment.ok else ""
                T, covariance = fused.T_first_map[k], fused.motion_covariance[k]
            of = self.iteration, self.name, name, kinds[name]
            events.append(Event(*of, T, covariance, reason))
        return events

    def _adopt(self, fused: FusedMap, names: Sequence[str], maps: Sequence[TimedMap]) -> None:
        """Go on in a fused map."""
        assert self._smoothed is not None
        given, log = self.given, first_frames(self.given.log, self.iteration + 1)
        offset_m2 = 0.0 if log.observations.track is None else given.filter.stray_m**2
        prior = prior_of(fused, maps, self._smoothed, log, offset_m2)
        self.filter.restart(prior)
        self.fused, self.origins = fused, {}
        with_others = np.any(fused.parents[:, 1:] != ABSENT, axis=1)
        self._shared = frozenset(prior.source[with_others].tolist())
        for row, source in enumerate(prior.source.tolist()):
            if source >= ADOPTED:
                k = int(np.flatnonzero(fused.parents[row] != ABSENT)[0])
                parent = fused.parents[row, k]
                own_row = int(maps[k].landmarks.source_observation[parent])
                self.origins[source] = Origin(names[k], own_row)


def _as_rows(source: np.ndarray) -> np.ndarray:
    """Return sources (N,) of landmarks, those of adopted ones replaced by own observations.

    A landmark is named by the row of the first observation of it in the robot's own log.
    """
    rows = np.flatnonzero(source >= ADOPTED)
    names, first, inverse = np.unique(source[rows], return_index=True, return_inverse=True)
    renamed = source.copy()
    if len(names):
        renamed[rows] = rows[first][inverse]
    return renamed


def _alone(landmarks: LandmarkMap) -> FusedMap:
    """Return a robot's own map as if it were fused."""
    parents = np.arange(len(landmarks))[:, None]
    zeros = np.zeros((1, 3)), np.zeros((1, 3, 3)), np.zeros(1)
    return FusedMap(landmarks, parents, *zeros, 0.0, ())
