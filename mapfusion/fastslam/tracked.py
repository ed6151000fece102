"""Which landmarks the tracks of the last frame went into.

All observations of a track are of one point, which lies somewhat beside the landmark: what is sure
about the one is less so about the other, and about the point that the next track will be of.
"""

import numpy as np

from mapfusion.fastslam.slots import FREE, Slots
from mapfusion.kernels import kernel


class Tracked:
    """The slots of each track that the last frame held."""

    def __init__(self) -> None:
        self._track = self._slot = self._source = np.empty(0, dtype=np.int64)

    def ended(self, track: np.ndarray | None, slots: Slots) -> np.ndarray:
        """Slots (n,) of tracks that go on in none of this frame's observations (K,); once each."""
        if track is not None and len(track):
            known = np.sort(track)
            place = np.minimum(np.searchsorted(known, self._track), len(known) - 1)
            over = known[place] != self._track
        else:
            over = np.ones(len(self._track), dtype=bool)
        # A landmark that no particle has any more is gone, and its slot may be another's by now.
        over &= slots.generation[self._slot] != FREE
        over &= slots.source[self._slot] == self._source
        return np.unique(self._slot[over])

    def went_into(
        self, track: np.ndarray | None, chosen: np.ndarray, created: np.ndarray, slots: Slots
    ) -> None:
        """Keep the slots of a frame.

        Args:
            track: (K,) of its observations.
            chosen: (K, M) the slots, or something negative.
            created: (n, 2) rows of observations that began a slot, and the slot.
            slots: the landmarks.
        """
        if track is None:
            self._track = self._slot = self._source = np.empty(0, dtype=np.int64)
            return
        pairs = np.concatenate([_distinct(chosen), created])
        self._track, self._slot = track[pairs[:, 0]], pairs[:, 1]
        self._source = slots.source[self._slot]


@kernel
def _distinct(chosen: np.ndarray) -> np.ndarray:
    """Rows and slots (n, 2) of `chosen` (K, M), each once: most particles choose the same slot."""
    pairs = np.empty((chosen.size, 2), dtype=np.int64)
    n = 0
    for k in range(chosen.shape[0]):
        first = n
        for m in range(chosen.shape[1]):
            s = chosen[k, m]
            if s < 0:
                continue
            known = False
            for i in range(first, n):
                known = known or pairs[i, 1] == s
            if not known:
                pairs[n, 0], pairs[n, 1] = k, s
                n += 1
    return pairs[:n].copy()
