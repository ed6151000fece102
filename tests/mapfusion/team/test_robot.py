"""Tests of `mapfusion.team.robot`."""

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapfusion.align.alignment import Status
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.geometry.se2 import between
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import first_frames
from mapfusion.team.adoption import ADOPTED
from mapfusion.team.map_message import MapMessage
from mapfusion.team.robot import Event, TeamRobot
from mapfusion.verification.registration import Registration
from mapfusion.verification.rivals import DISTINCT_M
from tests.mapfusion.team.teams_of_points import (
    NORTH,
    Drive,
    adopted,
    drive,
    errors_m,
    given,
    kinds,
    merging,
    smoothed_of,
)

# Robots that see much of what the others saw within 30 frames.
STARTS = {"north": NORTH, "south": (4.0, 3.0, 2.5), "west": (-4.0, 2.0, -2.6)}
Refused = Callable[[tuple[str, str], int], bool]


def drives(*names: str, n_frames: int = 80) -> list[Drive]:
    return [drive(0, name, STARTS[name], n_frames) for name in names]


def robots(*drives: Drive, n_frames: int = 0) -> list[TeamRobot]:
    made = [TeamRobot(each, merging(), seed=0) for each in given(*drives)]
    go_on(made, n_frames)
    return made


def go_on(team: Sequence[TeamRobot], n_frames: int) -> None:
    for robot in team:
        for _ in range(n_frames):
            if not robot.has_ended:
                robot.step()


def exchange(
    team: Sequence[TeamRobot], lost: Iterable[tuple[str, str]] = ()
) -> dict[tuple[str, str], MapMessage]:
    """Send all maps but those that are lost; return the messages by sender and receiver."""
    messages = {}
    for robot in team:
        robot.smooth()
        for other in team:
            message = robot.message_to(other.name) if other is not robot else None
            if message is not None:
                messages[robot.name, other.name] = message
    for (sender, receiver), message in messages.items():
        if (sender, receiver) not in lost:
            by_name(team, receiver).receive(sender, message)
    return messages


def by_name(team: Sequence[TeamRobot], name: str) -> TeamRobot:
    return next(each for each in team if each.name == name)


def meet(team: Sequence[TeamRobot], n_times: int, every: int = 10) -> list[Event]:
    """Drive on, exchange and merge, some times."""
    events = []
    for _ in range(n_times):
        go_on(team, every)
        exchange(team)
        events += [event for robot in team for event in robot.merge()]
    return events


def refuse(monkeypatch: pytest.MonkeyPatch, is_refused: Refused) -> None:
    """Refuse alignments of two robots at some iterations."""
    align = TeamRobot._align

    def refusing(self: TeamRobot, names, maps, versions):
        found = align(self, names, maps, versions)
        if not is_refused(names, self.iteration):
            return found
        refused = replace(found.alignment, status=Status.REFUSED, reason="forced")
        return found._replace(alignment=refused, is_confirmed=False)

    monkeypatch.setattr(TeamRobot, "_align", refusing)


def received(robot: TeamRobot, sender: str) -> LandmarkMap:
    """Return the last map from another robot."""
    return robot._received[sender][1].timed().landmarks


def assert_has_map_of(robot: TeamRobot, sender: TeamRobot) -> None:
    """The receiver has the sender's landmarks, at most half a sigma and a rounding off."""
    assert sender.own is not None
    own, found = sender.own.landmarks, received(robot, sender.name)
    own = own[np.argsort(own.source_observation)]
    np.testing.assert_array_equal(found.source_observation, own.source_observation)
    off_m = np.linalg.norm(found.position_m - own.position_m, axis=1)
    sigma_m = np.sqrt(np.trace(own.covariance_m2, axis1=1, axis2=2))
    assert np.all(off_m <= 0.5 * sigma_m + 1e-6)


def test_before_it_has_a_map_a_robot_sends_nothing() -> None:
    (robot,) = robots(*drives("north"))
    assert robot.iteration == -1
    go_on([robot], 2)
    robot.smooth()  # each landmark was seen twice; a map needs three observations
    assert robot.message_to("south") is None
    assert robot.merge() == []


def test_a_message_holds_the_robots_own_map_alone() -> None:
    team = robots(*drives("north", "south"))
    meet(team, 4)
    north, south = team
    assert north.adopted == ("south",)
    go_on(team, 10)
    exchange(team)
    found = received(south, "north")
    assert found.source_observation.max() < len(north.given.log.observations)
    assert_has_map_of(south, north)
    # as certain as without the other robot
    alone = smoothed_of(first_frames(north.given.log, 50))[1].landmarks
    assert found.label is not None
    assert alone.label is not None
    _, rows, of_alone = np.intersect1d(found.label, alone.label, return_indices=True)
    assert len(rows) > 0.95 * len(alone)
    found_m2, alone_m2 = found.covariance_m2[rows], alone.covariance_m2[of_alone]
    share = np.trace(found_m2, axis1=1, axis2=2) / np.trace(alone_m2, axis1=1, axis2=2)
    assert np.median(share) == pytest.approx(1.0, abs=0.05)


def test_after_a_receipt_only_changes_are_sent() -> None:
    team = robots(*drives("north", "south"), n_frames=30)
    sizes, bases = [], []
    for _ in range(4):
        message = exchange(team)["north", "south"]
        sizes.append(message.n_bytes)
        bases.append(message.base)
        assert_has_map_of(team[1], team[0])
        go_on(team, 1)
    # the receipt of a map comes with the message after the next one
    assert bases == [0, 0, 1, 2]
    assert sizes[0] < 1.1 * sizes[1]
    assert max(sizes[2:]) < 0.7 * sizes[1]


def test_the_next_message_makes_up_for_a_lost_one() -> None:
    team = robots(*drives("north", "south"), n_frames=20)
    for lost in ([], [], [("north", "south")], [], [("south", "north")], []):
        before = team[1]._received.get("north")
        exchange(team, lost)
        if ("north", "south") in lost:
            assert team[1]._received["north"] is before
        else:
            assert_has_map_of(team[1], team[0])
        go_on(team, 10)


def test_a_message_that_builds_on_an_unknown_map_is_ignored() -> None:
    team = robots(*drives("north", "south"), n_frames=20)
    for _ in range(3):
        messages = exchange(team)
    message = messages["north", "south"]
    assert message.base > 0
    (newcomer,) = robots(*drives("west"))
    newcomer.receive("north", message)
    assert newcomer._received == {}


def test_a_map_is_adopted_when_it_is_accepted_twice() -> None:
    team = robots(*drives("north", "south"))
    events = meet(team, 4)
    for robot, other in (("north", "south"), ("south", "north")):
        assert kinds(events, robot) == [("on trial", other), ("adopted", other)]
        times = [event.iteration for event in events if event.robot == robot]
        assert times[1] == times[0] + 10
    T_world_robot = [drive.T_world_robot[0] for drive in drives("north", "south")]
    for event in events:
        true = between(*(T_world_robot if event.robot == "north" else T_world_robot[::-1]))
        off = event.T_robot_other - true
        assert off @ np.linalg.solve(event.covariance, off) < 21  # 0.9999 of 3 degrees of freedom


def test_a_map_whose_second_motion_differs_is_not_adopted(monkeypatch) -> None:
    """The motions of two exchanges differ by more than the bound."""
    register, calls = Registration.register, itertools.count()

    def moving(self: Registration, *args):
        found = register(self, *args)
        T = found.refined.T_a_b + np.array([1.5 * DISTINCT_M * (next(calls) // 2), 0.0, 0.0])
        return found._replace(refined=replace(found.refined, T_a_b=T))

    monkeypatch.setattr(Registration, "register", moving)
    team = robots(*drives("north", "south"))
    events = meet(team, 5)
    assert {event.kind for event in events} == {"on trial"}
    assert all(robot.adopted == () for robot in team)


def test_adopted_landmarks_name_the_observations_they_come_from() -> None:
    team, of_drives = robots(*drives("north", "south")), drives("north", "south")
    meet(team, 4)
    for robot, other, own in zip(team, team[::-1], of_drives, strict=True):
        landmarks = adopted(robot.filter.best_map(1))
        label, other_log = landmarks.label, other.given.log
        assert label is not None
        assert len(landmarks) > 5
        assert other_log.observations.label is not None
        for source, name in zip(landmarks.source_observation.tolist(), label, strict=True):
            origin = robot.origins[source]
            assert origin.robot == other.name
            assert other_log.observations.label[origin.row] == name
        assert np.abs(errors_m(landmarks, own)).max() < 0.15


def test_shared_observations_are_those_of_landmarks_that_others_mapped() -> None:
    team = robots(*drives("north", "south"))
    go_on(team, 10)
    assert team[0].n_shared_now() == 0
    meet(team, 3)
    north = team[0]
    fused = north.fused
    assert fused is not None
    assert fused.landmarks.label is not None
    of_others = np.any(fused.parents[:, 1:] != ABSENT, axis=1)
    shared = set(fused.landmarks.label[of_others].tolist())
    go_on(team, 1)
    log = north.given.log
    assert log.observations.label is not None
    seen = log.observations.label[log.iteration == north.iteration].tolist()
    assert north.n_shared_now() == sum(label in shared for label in seen) > 3


def test_a_map_that_is_refused_is_kept_once_and_then_dropped(monkeypatch) -> None:
    team = robots(*drives("north", "south"))
    refuse(monkeypatch, lambda names, iteration: iteration >= 40)
    north = team[0]
    assert kinds(meet(team, 4), "north")[-1] == ("adopted", "south")
    fused, before = north.fused, len(adopted(north.filter.best_map(1)))
    assert before > 5

    go_on(team, 10)
    path = north.filter.best_path()
    exchange(team)
    kept = north.merge()
    assert kinds(kept, "north") == [("kept", "south")]
    assert kept[0].reason == "forced"
    assert north.adopted == ("south",)
    assert north.fused is fused
    np.testing.assert_array_equal(north.filter.best_path(), path)
    assert len(adopted(north.filter.best_map(1))) == before

    assert kinds(meet(team, 1), "north") == [("dropped", "south")]
    assert north.adopted == ()
    assert north.origins == {}
    assert north.own is not None
    found, own = north.filter.best_map(1), north.own.landmarks
    assert len(adopted(found)) == 0
    order = np.argsort(own.source_observation)
    np.testing.assert_array_equal(found.source_observation, own.source_observation[order])
    np.testing.assert_array_equal(found.position_m, own.position_m[order])
    go_on(team, 1)
    assert north.n_shared_now() == 0
    assert kinds(meet(team, 1), "north") == []


def test_a_robot_that_fits_the_second_alone_joins_the_map_of_the_first(monkeypatch) -> None:
    refuse(monkeypatch, lambda names, iteration: set(names) == {"north", "west"})
    of_drives = drives("north", "south", "west")
    team = robots(*of_drives)
    meet(team, 4)
    assert team[0].adopted == ("south", "west")
    assert team[2].adopted == ("north", "south")
    fused = team[0].fused
    assert fused is not None
    for k, other in enumerate(of_drives[1:], start=1):
        true = between(of_drives[0].T_world_robot[0], other.T_world_robot[0])
        np.testing.assert_allclose(fused.T_first_map[k], true, atol=0.1)
    landmarks = adopted(team[0].filter.best_map(1))
    of_west = [
        team[0].origins[source].robot == "west" for source in landmarks.source_observation.tolist()
    ]
    assert sum(of_west) > 1
    assert np.abs(errors_m(landmarks, of_drives[0])[of_west]).max() < 0.15


def test_robots_that_stand_still_do_not_become_more_certain() -> None:
    """Both logs end after 40 frames; the maps are exchanged and fused five times more."""
    team = robots(*drives("north", "south", n_frames=40))
    meet(team, 4)
    assert all(robot.has_ended for robot in team)
    assert all(robot.adopted for robot in team)
    before = [robot.filter.best_map(1, with_drift=True) for robot in team]
    assert [event.kind for event in meet(team, 5)] == []
    for robot, was in zip(team, before, strict=True):
        now = robot.filter.best_map(1, with_drift=True)
        assert len(adopted(now)) == len(adopted(was)) > 5
        np.testing.assert_allclose(now.position_m, was.position_m, atol=5e-3)
        share = np.trace(now.covariance_m2, axis1=1, axis2=2) / np.trace(
            was.covariance_m2, axis1=1, axis2=2
        )
        assert share.min() > 0.97
        assert share.max() < 1.2


def test_landmarks_of_others_become_the_robots_own_when_it_sees_them() -> None:
    team = robots(*drives("north", "south"))
    meet(team, 3)
    north = team[0]
    fused = north.fused
    assert fused is not None
    assert fused.landmarks.label is not None
    theirs = set(fused.landmarks.label[fused.parents[:, 0] == ABSENT].tolist())
    meet(team, 2)
    assert north.own is not None
    own = north.own.landmarks
    assert own.label is not None
    seen = np.isin(own.label, list(theirs))
    assert np.count_nonzero(seen) > 3
    labels = north.given.log.observations.label
    assert labels is not None
    assert own.source_observation.max() < ADOPTED
    np.testing.assert_array_equal(labels[own.source_observation], own.label)
    # one landmark a label: observations before and after the adoption belong together
    assert len(np.unique(own.label)) == len(own)


def test_one_refusal_does_not_drop_a_map(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse(monkeypatch, lambda names, iteration: iteration == 49)
    team = robots(*drives("north", "south"))
    assert [e.kind for e in meet(team, 7) if e.robot == "north"] == ["on trial", "adopted", "kept"]
    assert team[0].adopted == ("south",)


def test_an_adoption_is_told_when_it_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    """South is refused from frame 49 on; west is confirmed at the same exchange."""

    def refused(names: tuple[str, str], iteration: int) -> bool:
        late, pair = iteration >= 49, set(names)
        early_west = pair == {"north", "west"} and iteration < 39
        return (names == ("north", "south") and late) or early_west or pair == {"south", "west"}

    refuse(monkeypatch, refused)
    team = robots(*drives("north", "south", "west"))
    for _ in range(7):
        for event in meet(team, 1):
            if event.robot == "north" and event.kind == "adopted":
                assert event.other in team[0].adopted


def test_a_failed_smoothing_does_not_turn_the_filter_back(monkeypatch: pytest.MonkeyPatch) -> None:
    team = robots(*drives("north", "south"))
    meet(team, 4)
    assert team[0].adopted

    def fails(*given: object, **named: object) -> None:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr("mapfusion.team.robot.smooth", fails)
    told = [event for event in meet(team, 1) if event.robot == "north"]
    assert [(e.kind, e.reason) for e in told] == [("not smoothed", "smoothing fails: singular")]
    assert len(team[0].filter.best_path()) == 50


def test_an_adoption_by_way_of_another_robot_tells_its_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The own alignment of north with west is refused and wrong."""
    align = TeamRobot._align

    def wrong(robot, names, maps, versions):
        found = align(robot, names, maps, versions)
        if set(names) != {"north", "west"}:
            return found
        refused = {"T_a_b": np.full(3, 9.0), "status": Status.REFUSED, "reason": "forced"}
        return found._replace(alignment=replace(found.alignment, **refused), is_confirmed=False)

    monkeypatch.setattr(TeamRobot, "_align", wrong)
    driven = drives("north", "south", "west")
    events = [e for e in meet(robots(*driven), 4) if e.robot == "north"]
    (event,) = [e for e in events if (e.kind, e.other) == ("adopted", "west")]
    true = between(driven[0].T_world_robot[0], driven[2].T_world_robot[0])
    np.testing.assert_allclose(event.T_robot_other, true, atol=0.1)
    assert event.reason == ""


def test_a_trial_is_told_once() -> None:
    """Both logs end while the alignment is on trial."""
    team = robots(*drives("north", "south", n_frames=30))
    told = [event.kind for event in meet(team, 6) if event.robot == "north"]
    assert told.count("on trial") == 1
