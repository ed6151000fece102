"""An order of poses in which those that have to do with each other are near each other.

Poses that saw no landmark in common have a zero between them. In such an order what is not zero
lies near the diagonal, and a factor has no more than zeros before the first entry of each row (the
envelope: George and Liu 1981, "Computer Solution of Large Sparse Positive Definite Systems", ch.
4). Orders are that of Cuthill and McKee (1969), those of searches like theirs that begin at other
poses, spread over the log, and what comes of them when each pose is drawn to the mean of those that
it has to do with; while nothing was seen again that of time is as good.
"""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, reverse_cuthill_mckee

# Members that an order is sought from, and sweeps over the best of those: more make it better by a
# tenth, and a factor with half the entries is worth some dozen milliseconds of search.
_BEGINS, _SWEEPS = 16, 4


def envelope_order(group: np.ndarray, member: np.ndarray, n_members: int) -> np.ndarray:
    """(n_members,) place of each in an order that has those of one group near each other.

    Args:
        group: (N,) numbers of groups; each of its members has to do with all others of it.
        member: (N,) who is in it.
        n_members: neighbours by number have to do with each other, too.
    """
    by_number = np.arange(n_members)
    if n_members < 2:
        return by_number
    related = _related(group, member, n_members)
    starts, column = related.indptr[:-1], related.indices.astype(np.int64)

    def work(place: np.ndarray) -> int:
        """What a factor costs: the squares of its rows' lengths."""
        return int(np.sum((place - np.minimum.reduceat(place[column], starts)) ** 2))

    begins = np.unique(np.linspace(0, n_members - 1, _BEGINS).round().astype(np.int64))
    found = [breadth_first_order(related, each, return_predecessors=False)[::-1] for each in begins]
    found.append(reverse_cuthill_mckee(related, symmetric_mode=True))
    swept = min(map(_places, found), key=work)
    orders = [by_number, swept]
    for _ in range(_SWEEPS):
        mean = related @ swept / np.diff(related.indptr)
        swept = _places(np.argsort(mean, kind="stable"))
        orders += [swept, n_members - 1 - swept]
    return min(orders, key=work)


def _related(group: np.ndarray, member: np.ndarray, n_members: int) -> csr_matrix:
    """(n_members, n_members) ones where two have to do with each other, each with itself."""
    chain = np.arange(n_members - 1)
    n_groups = int(group.max(initial=-1)) + 1
    groups = np.concatenate([group, n_groups + chain, n_groups + chain])
    members = np.concatenate([member, chain, chain + 1])
    shape = (n_members, n_groups + len(chain))
    has = csr_matrix((np.ones(len(groups)), (members, groups)), shape=shape)
    related = (has @ has.T).tocsr()
    related.data[:] = 1.0
    return related


def _places(order: np.ndarray) -> np.ndarray:
    """(n,) place of each member in an order (n,) of all members."""
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return place


def first_entries(group: np.ndarray, member: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(n,) by place: the first place that each has to do with, its own if there is none before it.

    Groups and members are those of `envelope_order`, `place` (n,) is what it gave.
    """
    n, at = len(place), place[member]
    first, least = np.arange(n), np.full(int(group.max(initial=-1)) + 1, n)
    np.minimum.at(least, group, at)
    np.minimum.at(first, at, least[group])
    np.minimum.at(first, np.maximum(place[1:], place[:-1]), np.minimum(place[1:], place[:-1]))
    return first
