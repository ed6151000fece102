"""Tests of `mapfusion.team.link`."""

from typing import Any

import numpy as np
import pytest

from mapfusion.camera import EXACT
from mapfusion.team.link import Link, LinkParameters
from mapfusion.team.map_message import MapHeader, MapMessage

_NUMBERS = 4 * 2  # bytes of the two versions


def message(n_bytes: int) -> MapMessage:
    """Return a message of this size, which removes landmarks alone."""
    nothing = np.zeros(0)
    header = MapHeader("R1", True, 1, EXACT, None, False, None, nothing, nothing)
    removed = np.zeros((n_bytes - _NUMBERS) // 4, dtype=np.int32)
    rest = nothing.astype(bool), nothing, nothing, removed, nothing.astype(int), nothing, {}
    made = MapMessage(1, 0, header, nothing, *rest)
    assert made.n_bytes == n_bytes
    return made


def link(seed: int = 0, **settings: Any) -> Link:
    return Link(3, LinkParameters(**settings), np.random.default_rng(seed))


@pytest.mark.parametrize("loss", [0.0, 0.3, 1.0])
def test_share_of_lost_messages_is_the_probability(loss: float) -> None:
    made, n = link(loss=loss), 2000
    sent = [made.send(0, 1, message(8), 0.0, 0.0) for _ in range(n)]
    n_lost = sum(each.is_lost for each in sent)
    assert abs(n_lost - loss * n) <= 4 * np.sqrt(n * loss * (1 - loss))
    assert len(made.arrived(1e9)) == n - n_lost


def test_messages_of_one_transmitter_wait_for_each_other() -> None:
    """100 bytes/s: 800 bytes take 8 s, 400 bytes 4 s; then 0.5 s of delay."""
    made = link(bytes_per_s=100, delay_s=0.5)
    assert made.send(0, 1, message(800), 10.0, 0.0).arrives_s == pytest.approx(18.5)
    assert made.send(0, 2, message(400), 10.0, 0.0).arrives_s == pytest.approx(22.5)
    assert made.send(1, 2, message(400), 10.0, 0.0).arrives_s == pytest.approx(14.5)
    assert [made.is_free(k, 14.0) for k in range(3)] == [False, True, True]
    assert not made.is_free(0, 21.9)
    assert made.is_free(0, 22.0)
    assert made.send(0, 1, message(100), 30.0, 0.0).arrives_s == pytest.approx(31.5)


def test_a_lost_message_takes_the_transmitter_as_long() -> None:
    made = link(bytes_per_s=100, loss=1.0)
    made.send(0, 1, message(800), 0.0, 0.0)
    assert not made.is_free(0, 7.9)


def test_messages_arrive_once_in_the_order_of_their_arrival() -> None:
    made = link(bytes_per_s=100)
    made.send(0, 1, message(800), 0.0, 0.0)
    made.send(1, 0, message(400), 1.0, 0.0)
    made.send(2, 0, message(400), 1.0, 0.0)
    assert made.arrived(4.9) == []
    assert [(each.sender, each.arrives_s) for each in made.arrived(8.0)] == [(1, 5), (2, 5), (0, 8)]
    assert made.arrived(1e9) == []


def test_robots_out_of_range_do_not_hear_each_other() -> None:
    made = link(range_m=15.0)
    sent = [made.send(0, 1, message(8), 0.0, distance_m) for distance_m in (0.0, 15.0, 15.1)]
    assert [each.is_lost for each in sent] == [False, False, True]


def test_the_same_messages_are_lost_at_any_rate_and_range() -> None:
    lost = []
    varied: list[dict[str, Any]] = [{}, {}, {"bytes_per_s": 10.0}, {"range_m": 1.0}]
    for settings in varied:
        made = link(5, loss=0.5, **settings)
        lost.append([made.send(0, 1, message(8), k, 0.0).is_lost for k in range(50)])
    assert lost[0] == lost[1] == lost[2] == lost[3]
    assert 10 < sum(lost[0]) < 40


@pytest.mark.parametrize(
    ("name", "value"),
    [("every", 4), ("loss", 1.1), ("delay_s", -1.0), ("bytes_per_s", 0.0), ("range_m", -1.0)],
)
def test_wrong_settings_are_named(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        LinkParameters(**{name: value})
