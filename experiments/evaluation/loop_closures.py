"""Loop closures of a robot: landmarks that come into view again after newly explored areas.

The paper (section 4, figures 2 and 3) says that the particles spread on new ground and draw
together when the robot closes a loop and sees landmarks again that it had mapped before.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd

from mapfusion.robot_log import RobotLog

# A landmark that was out of view for more frames has come back: 10 s at the default frame rate. The
# gaps of a landmark that stays in view, behind a door post or in a blurred image, are shorter.
OUT_OF_VIEW_FRAMES = 50
# Frames before and after a closure that are compared; a robot drives about 5 m in this time.
WINDOW_FRAMES = 50
# Share of landmarks that have come back among those that come into view. In newly explored areas,
# few are old ones seen from afar. On known ground, most are, and the others are corners that were
# missed.
_MOST_ON_NEW_GROUND, _LEAST_ON_KNOWN_GROUND = 0.25, 0.5
# Landmarks that come into view in a window; shares of fewer are chance.
_LEAST_LANDMARKS = 20


def sighting_rows(log: RobotLog, source: np.ndarray) -> pd.DataFrame:
    """Return the rows of the table `sightings`, without the robot.

    Args:
        log: measurements of the robot.
        source: row of the observation that created the landmark of each observation, -1 for none,
            shape (n,); of the most probable particle at the end.
    """
    frame, row, seen = log.iteration.astype(np.int64), np.arange(len(source)), source >= 0
    rows = pd.DataFrame({"frame": frame, "landmark": source})[seen]
    gap = rows["frame"] - rows.groupby("landmark")["frame"].shift()
    track = log.observations.track
    counted = {"n_observed": np.ones(len(frame), bool), "n_new": seen & (source == row)}
    counted["n_returned"] = seen.copy()
    counted["n_returned"][seen] = gap > OUT_OF_VIEW_FRAMES
    if track is not None:
        counted["n_tracked"] = pd.Series(track).duplicated().to_numpy()
    n = len(log)
    numbers = {name: np.bincount(frame[which], minlength=n) for name, which in counted.items()}
    numbers.setdefault("n_tracked", np.zeros(n, np.int64))
    return pd.DataFrame({"iteration": np.arange(n)} | numbers)


class LoopClosure(NamedTuple):
    """Closure of a loop by a robot.

    Attributes:
        robot: name of the robot.
        iteration: first frame on known ground.
        n_returned: landmarks that came back in the window after it.
        before_m: median spread of the particles in the window before it.
        after_m: median spread in the window after it.
    """

    robot: str
    iteration: int
    n_returned: int
    before_m: float
    after_m: float


def loop_closures(sightings: pd.DataFrame, spread: pd.DataFrame) -> list[LoopClosure]:
    """Return the loop closures of all robots of a run, in the order of the robots and of time.

    Args:
        sightings: rows of the table `sightings`.
        spread: robot, iteration and spread_m of the particles, at some iterations at least.
    """
    closures = []
    for robot, rows in sightings.groupby("robot", sort=False):
        rows, own = rows.sort_values("iteration"), spread[spread["robot"] == robot]
        new, returned = (rows[name].to_numpy() for name in ("n_new", "n_returned"))
        for k in _closing_frames(new, returned):
            before = own["iteration"].between(k - WINDOW_FRAMES, k - 1)
            after = own["iteration"].between(k, k + WINDOW_FRAMES - 1)
            spreads = [float(own.loc[window, "spread_m"].median()) for window in (before, after)]
            n_returned = int(returned[k : k + WINDOW_FRAMES].sum())
            closures.append(LoopClosure(str(robot), k, n_returned, *spreads))
    return closures


def _closing_frames(new: np.ndarray, returned: np.ndarray) -> list[int]:
    """Return the frames at which a robot comes from new to known ground.

    Of adjacent candidates, the frame with the largest change of the share of returned landmarks is
    chosen.

    Args:
        new: number of landmarks created in each frame, shape (T,).
        returned: number of landmarks that came back in each frame, shape (T,).
    """
    if len(new) < 2 * WINDOW_FRAMES:
        return []

    def sums(counts: np.ndarray) -> np.ndarray:
        """Return the sums over the windows that begin at each frame."""
        return np.convolve(counts, np.ones(WINDOW_FRAMES), mode="valid")

    came_back, in_view = sums(returned), sums(returned) + sums(new)
    share = came_back / np.where(in_view >= _LEAST_LANDMARKS, in_view, np.nan)
    before, after = share[:-WINDOW_FRAMES], share[WINDOW_FRAMES:]
    closes = (before <= _MOST_ON_NEW_GROUND) & (after >= _LEAST_ON_KNOWN_GROUND)
    at = np.flatnonzero(closes)
    adjacent = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
    rise = after - before
    return [WINDOW_FRAMES + int(run[np.argmax(rise[run])]) for run in adjacent if len(run)]
