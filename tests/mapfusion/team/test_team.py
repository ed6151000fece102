"""Tests of `mapfusion.team.team`."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapfusion.fastslam.mapping import run_log
from mapfusion.geometry.numerics import Float, chi_square_bound, generator
from mapfusion.geometry.se2 import between
from mapfusion.robot_log import RobotLog
from mapfusion.team.link import LinkParameters
from mapfusion.team.robot import TeamRobot
from mapfusion.team.team import Team, path_distances
from tests.mapfusion.team.teams_of_points import (
    EVERY,
    FILTER,
    SOUTH,
    Voyage,
    adopted,
    drive,
    errors_m,
    given,
    kinds,
    merging,
    path_errors_m,
    usual_voyage,
    voyage,
)


def path_alone(log: RobotLog, seed: int = 0) -> Float:
    """Return the path of an independent robot."""
    frames = list(run_log(log, FILTER, generator(seed, "slam", log.robot)))
    return frames[-1].slam.best_path()


def assert_equal(robot: TeamRobot, other: TeamRobot) -> None:
    """Two robots have bit-equal results."""
    np.testing.assert_array_equal(robot.filter.best_path(), other.filter.best_path())
    found, expected = robot.filter.best_map(1, True), other.filter.best_map(1, True)
    for name in ("position_m", "covariance_m2", "source_observation", "count"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert robot.origins == other.origins
    assert robot.adopted == other.adopted


def test_maps_are_exchanged_when_they_are_due() -> None:
    found = usual_voyage()
    for moment in found.moments:
        is_due = moment.iteration > 0 and moment.iteration % EVERY == 0
        assert [(each.sender, each.receiver) for each in moment.sent] == (
            [(0, 1), (1, 0)] if is_due else []
        )
        assert is_due or not moment.events
        assert len(moment.frames) == len(moment.seconds) == 2


@cache
def several() -> list[Voyage]:
    """Return teams of several seeds, which end some frames after the adoption."""
    return [
        voyage(drive(seed, n_frames=62), drive(seed, "south", SOUTH, 62), seed=seed)
        for seed in range(4)
    ]


def test_the_path_in_the_joint_map_is_as_good_as_alone() -> None:
    ratios = []
    for seed, found in enumerate(several()):
        for robot, own in zip(found.team.robots, found.drives, strict=True):
            assert robot.adopted
            joint, alone = robot.filter.best_path(), path_alone(own.log, seed)
            errors = [np.sqrt(np.mean(path_errors_m(path, own) ** 2)) for path in (joint, alone)]
            assert errors[0] < 0.06
            ratios.append(errors[0] / errors[1])
    assert np.median(ratios) < 1.1
    assert max(ratios) < 2.0


def test_adopted_landmarks_are_where_they_are_said_to_be() -> None:
    squares, errors = [], []
    for found in several():
        for robot, own in zip(found.team.robots, found.drives, strict=True):
            landmarks = adopted(robot.filter.best_map(1, with_drift=True))
            assert len(landmarks) > 3
            off = errors_m(landmarks, own)
            errors.append(off)
            S = landmarks.covariance_m2[:, :2, :2]
            squares += np.vecdot(off, np.linalg.solve(S, off[..., None])[..., 0]).tolist()
    assert len(squares) > 60
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.05
    # Errors of a map's landmarks are correlated, so the mean scatters more than chi-square.
    assert 0.3 < np.mean(squares) / 2 < 2.5
    assert np.mean(np.array(squares) < 5.99) > 0.85


def test_the_same_seed_gives_the_same_bits() -> None:
    again = voyage(drive(0), drive(0, "south", SOUTH))
    for robot, other in zip(usual_voyage().team.robots, again.team.robots, strict=True):
        assert_equal(robot, other)


def test_the_order_of_the_robots_changes_only_their_order() -> None:
    turned = voyage(drive(0, "south", SOUTH), drive(0))
    assert [robot.name for robot in turned.team.robots] == ["south", "north"]
    for robot in usual_voyage().team.robots:
        assert_equal(turned.robot(robot.name), robot)


def test_without_messages_each_robot_is_independent() -> None:
    drives = drive(0, n_frames=60), drive(0, "south", SOUTH, 60)
    found = voyage(*drives, seed=3, link=LinkParameters(every=EVERY, loss=1.0))
    assert found.events == []
    assert all(each.is_lost for moment in found.moments for each in moment.sent)
    for robot, own in zip(found.team.robots, drives, strict=True):
        np.testing.assert_array_equal(robot.filter.best_path(), path_alone(own.log, 3))
        assert len(adopted(robot.filter.best_map(1))) == 0


def test_robots_without_common_ground_do_not_adopt() -> None:
    """The second robot is 50 m away, among other points with other labels."""
    far = drive(0, "south", (50.0, 5.0, 3.1), 60, (50.0, 0.0))
    found = voyage(drive(0, n_frames=60), far)
    assert found.events == []
    assert all(robot.adopted == () for robot in found.team.robots)
    assert len(found.team.robots[0]._received) == 1


def test_a_robot_whose_log_has_ended_still_sends_and_merges() -> None:
    short, long = drive(0, "south", SOUTH, 45), drive(0)
    found = voyage(short, long)
    assert all(moment.frames[0] is None for moment in found.moments[45:])
    assert found.robot("south").iteration == 44
    assert len(found.robot("south").filter.best_path()) == 45
    assert kinds(found.events, "south")[-1] == ("adopted", "north")
    assert kinds(found.events, "north")[-1] == ("adopted", "south")


def test_a_slow_transmitter_skips_exchanges() -> None:
    """A first map of more than 1250 bytes takes more than 5 s, the time between two exchanges."""
    drives = drive(0, n_frames=60), drive(0, "south", SOUTH, 60)
    found = voyage(*drives, link=LinkParameters(every=EVERY, bytes_per_s=250.0))
    free_s = {0: 0.0, 1: 0.0}
    for moment in found.moments[EVERY::EVERY]:
        now_s = moment.iteration / 2
        assert {each.sender for each in moment.sent} == {k for k in (0, 1) if free_s[k] <= now_s}
        for each in moment.sent:
            free_s[each.sender] = now_s + each.message.n_bytes / 250
            assert each.arrives_s == pytest.approx(free_s[each.sender])
    assert 2 < sum(len(moment.sent) for moment in found.moments) < 10


def test_robots_hear_each_other_within_the_range() -> None:
    """Both drive on circles with centres 10.6 m apart, so that their distance changes."""
    drives = drive(0, n_frames=61), drive(0, "south", (9.0, -3.0, 1.5), 61)
    paths = [own.T_world_robot for own in drives]
    apart_m = np.linalg.norm(paths[0][:, :2] - paths[1][:, :2], axis=1)[EVERY::EVERY]
    range_m = float(np.median(apart_m))
    link = LinkParameters(every=EVERY, range_m=range_m)
    team = Team(given(*drives), merging(), link, 0, path_distances(paths))
    sent = [team.step(k).sent for k in range(61)][EVERY::EVERY]
    for near, messages in zip(apart_m <= range_m, sent, strict=True):
        assert [each.is_lost for each in messages] == [not near] * 2
    assert 0 < np.count_nonzero(apart_m <= range_m) < 6
    off_m = (paths[0][17] - paths[1][4])[:2]
    assert path_distances(paths)(1, 4, 0, 17) == pytest.approx(np.linalg.norm(off_m))


@pytest.mark.parametrize(("delay_s", "frame"), [(0.0, 10), (3.0, 16)])
def test_messages_arrive_after_their_delay(delay_s: float, frame: int) -> None:
    """Frames are 0.5 s apart."""
    link = LinkParameters(every=EVERY, delay_s=delay_s)
    team = Team(given(drive(0), drive(0, "south", SOUTH)), merging(), link, 0)
    arrived = []
    for k in range(18):
        team.step(k)
        arrived.append("south" in team.robots[0]._received)
    assert arrived.index(True) == frame


def test_a_robot_that_was_carried_elsewhere_finds_itself() -> None:
    """South is north after it was carried; it joins when the log of north ends."""
    first, second = drive(0, n_frames=60), drive(0, "south", SOUTH, 60)
    inputs = given(first, second)
    inputs[1] = replace(inputs[1], predecessor="north")
    team = Team(inputs, merging(), LinkParameters(every=EVERY, loss=1.0), seed=0)
    assert team.starts == [0, 60]
    assert len(team.time_s) == 120
    moments = [team.step(k) for k in range(120)]
    assert moments[59].frames[1] is None
    assert moments[60].frames[0] is None
    events = [event for moment in moments for event in moment.events if event.robot == "south"]
    found = next(event for event in events if event.kind == "adopted")
    assert found.iteration % 5 == 0  # before the next exchange is due
    true = between(second.T_world_robot[0], first.T_world_robot[0])
    error = found.T_robot_other - true
    assert error @ np.linalg.solve(found.covariance, error) < chi_square_bound(0.999, 3)


def test_a_late_robot_joins() -> None:
    inputs = given(drive(0, n_frames=60), drive(0, "south", SOUTH, 60))
    inputs[1] = replace(inputs[1], start=30)
    team = Team(inputs, merging(), LinkParameters(every=EVERY), seed=0)
    events = [event for k in range(90) for event in team.step(k).events]
    assert {event.robot for event in events if event.kind == "adopted"} == {"north", "south"}
    assert all(event.iteration < 60 for event in events)
