"""Loop closures against a robot whose sightings are counted by hand."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation.loop_closures import (
    OUT_OF_VIEW_FRAMES,
    WINDOW_FRAMES,
    loop_closures,
    sighting_rows,
)


class ShownLog:
    """The part of a log that tells what each frame shows."""

    def __init__(self, landmarks_by_frame: list[list[int]]) -> None:
        self._n = len(landmarks_by_frame)
        self.iteration = np.repeat(np.arange(self._n), [*map(len, landmarks_by_frame)])
        self.observations = SimpleNamespace(track=None)

    def __len__(self) -> int:
        return self._n


def log_of(landmarks_by_frame: list[list[int]]) -> tuple[Any, np.ndarray]:
    """Return a log and the source of each observation, from the landmarks that each frame shows."""
    seen = np.concatenate([np.array(own, dtype=int) for own in landmarks_by_frame])
    first = {int(landmark): row for row, landmark in reversed([*enumerate(seen)])}
    source = np.array([first[int(landmark)] for landmark in seen])
    return ShownLog(landmarks_by_frame), source


def corridor(n_frames: int, back_at: int | None) -> list[list[int]]:
    """Three landmarks a frame come into view and stay two frames; from `back_at` on, the old."""
    shown = []
    for k in range(n_frames):
        place = k if back_at is None or k < back_at else k - back_at
        shown.append([3 * place + i for i in range(6)])
    return shown


def test_sightings_are_counted_frame_by_frame() -> None:
    gap = OUT_OF_VIEW_FRAMES
    log, source = log_of([[0, 1], [1, 2], *[[]] * (gap - 1), [1], [0]])
    source[2] = -1  # the second observation of landmark 1 was dropped
    rows = sighting_rows(log, source).set_index("iteration")
    assert rows["n_observed"].tolist() == [2, 2, *[0] * (gap - 1), 1, 1]
    assert rows["n_new"].sum() == 3
    # landmark 1 was last seen in frame 0, because its observation in frame 1 was dropped
    assert rows.index[rows["n_returned"] > 0].tolist() == [gap + 1, gap + 2]
    assert rows["n_tracked"].sum() == 0


def test_tracks_are_counted_from_their_second_observation() -> None:
    log, source = log_of([[0, 1], [0, 1, 2], [0]])
    log.observations.track = np.array([7, 8, 7, 9, 3, 7])
    rows = sighting_rows(log, source)
    assert rows["n_tracked"].tolist() == [0, 1, 1]


@pytest.mark.parametrize("back_at", [None, 140, 200])
def test_a_loop_closes_where_the_old_landmarks_come_back(back_at: int | None) -> None:
    log, source = log_of(corridor(300, back_at))
    sightings = sighting_rows(log, source).assign(robot="R1")
    iteration = np.arange(0, 300, 10)
    spread_m = np.where(iteration < (back_at or 0), 0.02, 0.01)
    spread = pd.DataFrame({"robot": "R1", "iteration": iteration, "spread_m": spread_m})
    found = loop_closures(sightings, spread)
    assert len(found) == (back_at is not None)
    for closure in found:
        assert closure.iteration == back_at
        assert (closure.before_m, closure.after_m) == (0.02, 0.01)
        assert closure.n_returned == 3 * WINDOW_FRAMES + 3


def test_a_robot_that_stays_on_known_ground_closes_one_loop() -> None:
    laps = [own for k in range(4) for own in corridor(100, None)]
    log, source = log_of(laps)
    sightings = sighting_rows(log, source).assign(robot="R1")
    spread = pd.DataFrame({"robot": "R1", "iteration": [0], "spread_m": [0.0]})
    assert [each.iteration for each in loop_closures(sightings, spread)] == [100]


def test_a_short_run_has_no_closure() -> None:
    log, source = log_of(corridor(2 * WINDOW_FRAMES - 1, 60))
    sightings = sighting_rows(log, source).assign(robot="R1")
    spread = pd.DataFrame({"robot": "R1", "iteration": [0], "spread_m": [0.0]})
    assert loop_closures(sightings, spread) == []
