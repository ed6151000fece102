"""Matching of maps by geometry alone: landmarks without descriptors and without labels.

A rigid motion preserves distances. Each segment between two landmarks of map b and each segment of
equal length of map a therefore propose a motion, and the motions of true segments agree (point-pair
voting: Drost et al. 2010; generalised Hough transform: Ballard 1981). Votes are counted in
overlapping bins of (theta, x, y). The motions of the fullest bins are refitted to the landmarks
that they lay on each other, and ranked by the surprise of their support.

Heights restrict the segments: the difference of height of both ends is equal in both maps, whatever
the constant height offset between the maps. The offset of a motion is the one that most of its
pairs share. Sizes and categories of landmarks restrict the pairs as well.

Not all pairs of landmarks are built. Segments are at most as long as their largest number allows,
and votes are counted for one part of map b at a time.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.align.nearest_neighbours import Grid, ranges_within
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry.numerics import Float, chi_square_bound, kernel
from mapfusion.geometry.se2 import rms_distance_m, rotation, transform_points
from mapfusion.landmark_map import LandmarkMap


class Site(NamedTuple):
    """N landmarks of one map, as arrays for kernels.

    Attributes:
        p: positions in the plane in metres, shape (N, 2).
        z: heights in metres, shape (N,); 0 for planar maps.
        most_z_m2: contribution to the largest squared difference of two heights, shape (N,);
            infinite for planar maps.
        size_m: sizes, shape (N,); NaN for none.
        category: categories, shape (N,); negative for none.
    """

    p: Float
    z: Float
    most_z_m2: Float
    size_m: Float
    category: np.ndarray

    @classmethod
    def of(cls, landmarks: LandmarkMap, height_bound: float, floor_m2: float) -> "Site":
        """Return the landmarks of a map.

        `height_bound` is the largest squared difference of two heights over its variance, which
        has the part `floor_m2` beyond the landmarks' own; infinite to ignore heights.
        """
        n = len(landmarks)
        max_z_m2 = np.full(n, np.inf)
        if math.isfinite(height_bound):
            max_z_m2 = height_bound * (landmarks.covariance_m2[:, 2, 2] + floor_m2 / 2)
        return cls(
            np.ascontiguousarray(landmarks.position_m[:, :2]),
            landmarks.position_m[:, 2].copy(),
            max_z_m2,
            np.full(n, np.nan) if landmarks.size_m is None else landmarks.size_m,
            np.full(n, -1) if landmarks.category is None else landmarks.category,
        )


class Placement(NamedTuple):
    """Motion between two maps, and the landmarks that it lays on each other.

    Attributes:
        T_a_b: motion, shape (3,).
        up_m: height of frame b in frame a.
        gate_m: distance in the plane up to which landmarks are paired.
        index_a, index_b: paired rows of map a and of map b, one to one, shape (K,).
        surprise: rank of the motion; see `surprise`.
    """

    T_a_b: Float
    up_m: float
    gate_m: float
    index_a: np.ndarray
    index_b: np.ndarray
    surprise: float


def have_attributes(a: Site, b: Site) -> bool:
    """Return True if both maps have sizes, or both have categories."""
    sized = (np.isnan(each.size_m).all() for each in (a, b))
    named = ((each.category < 0).all() for each in (a, b))
    return not any(sized) or not any(named)


@kernel
def attributes_agree(a: Site, b: Site, i: int, j: int, size_tolerance: float) -> bool:
    """Return True if the attributes of landmark i of a and j of b agree, or one has none."""
    if a.category[i] >= 0 and b.category[j] >= 0 and a.category[i] != b.category[j]:
        return False
    size_difference = abs(a.size_m[i] - b.size_m[j])  # NaN passes
    return not size_difference > size_tolerance * max(a.size_m[i], b.size_m[j])


_TINY_M = 1e-9  # avoids a division by the distance of equal places


class Segments(NamedTuple):
    """Segments between landmarks of one map, by ascending length.

    Attributes:
        length: lengths in metres, shape (E,).
        along: unit vectors from the first end to the second, shape (E, 2).
        theta_rad: their angles, shape (E,).
        middle: midpoints, shape (E, 2).
        rise: height of the second end above the first, shape (E,).
        most_z_m2: sum of the ends' contributions to the largest squared difference, shape (E,).
        ends: rows of the landmarks, shape (E, 2).
    """

    length: Float
    along: Float
    theta_rad: Float
    middle: Float
    rise: Float
    most_z_m2: Float
    ends: np.ndarray

    @classmethod
    def between(cls, site: Site, ends: np.ndarray) -> "Segments":
        """Return the segments between the given rows (E, 2)."""
        i, j = ends.T
        difference = site.p[j] - site.p[i]
        length = np.hypot(difference[:, 0], difference[:, 1])
        order = np.argsort(length, kind="stable")
        i, j, difference, length = i[order], j[order], difference[order], length[order]
        return cls(
            length,
            difference / np.maximum(length, _TINY_M)[:, None],
            np.arctan2(difference[:, 1], difference[:, 0]),
            (site.p[i] + site.p[j]) / 2,
            site.z[j] - site.z[i],
            site.most_z_m2[i] + site.most_z_m2[j],
            np.column_stack([i, j]),
        )


# Largest number of segments of a map, and of segments per landmark if there are many landmarks. The
# number of votes grows with the square of the first and with the product of the second.
_SEGMENTS, _SEGMENTS_EACH = 5_000, 6
# Lengths of segments in units of the tolerance: the angle of a shorter one is too uncertain. The
# shortest one is at most a quarter of the longest.
_SHORTEST = 10.0
_SHORTEST_SHARE = 0.25


def segment_lengths(a: Site, b: Site, tolerance_m: float) -> tuple[float, float]:
    """Return the shortest and the longest length of segments of two maps.

    Both maps have the same lengths, so that a true segment is in both.
    """
    longest = math.inf
    for site in (a, b):
        n = len(site.p)
        max_segments = max(_SEGMENTS, _SEGMENTS_EACH * n)
        if n * (n - 1) / 2 <= max_segments:
            continue
        tree = scipy.spatial.KDTree(site.p)
        high = float(np.hypot(*np.ptp(site.p, axis=0)))
        low = 0.0
        for _ in range(12):  # bisection; the number of segments grows with the square
            middle = (low + high) / 2
            within = (tree.count_neighbors(tree, middle) - n) // 2
            low, high = (middle, high) if within <= max_segments else (low, middle)
        longest = min(longest, low)
    if math.isinf(longest):
        longest = min(float(np.hypot(*np.ptp(site.p, axis=0))) for site in (a, b)) + tolerance_m
    return min(_SHORTEST * tolerance_m, _SHORTEST_SHARE * longest), longest


def segments_of(site: Site, shortest_m: float, longest_m: float) -> Segments:
    """Return the segments of a map between two lengths, each in one direction."""
    ends = scipy.spatial.KDTree(site.p).query_pairs(longest_m, output_type="ndarray")
    segments = Segments.between(site, ends.astype(np.int64).reshape(-1, 2))
    is_long = segments.length >= shortest_m
    return Segments(*(part[is_long] for part in segments))


def both_directions(segments: Segments) -> Segments:
    """Return each segment in both directions, by ascending length."""
    length, along, theta, middle, height_difference, max_z_m2, ends = segments
    return Segments(
        np.repeat(length, 2),
        np.stack([along, -along], axis=1).reshape(-1, 2),
        np.stack([theta, np.where(theta > 0, theta - math.pi, theta + math.pi)], axis=1).ravel(),
        np.repeat(middle, 2, axis=0),
        np.stack([height_difference, -height_difference], axis=1).ravel(),
        np.repeat(max_z_m2, 2),
        np.stack([ends, ends[:, ::-1]], axis=1).reshape(-1, 2),
    )


class Bins(NamedTuple):
    """Bins of votes.

    Attributes:
        theta_rad, shift_m: widths.
        n_theta: number of bins around the circle.
    """

    theta_rad: float
    shift_m: float
    n_theta: int


# Factors of the hash of a place (Teschner et al. 2003).
_HASH = 73856093, 19349663


@kernel
def _slot(x: int, y: int, mask: int) -> int:
    mixed = (x * _HASH[0]) ^ (y * _HASH[1])
    return (mixed ^ (mixed >> 17)) & mask


@kernel
def insert_bin(
    best: Float, n: int, bin_values: tuple[float, float, float, float], bins: Bins
) -> int:
    """Insert a bin (votes, theta, x, y) in descending order of votes; return the number of bins.

    Of bins next to each other only the fullest is kept. `best` (most, 4) holds n bins.
    """
    votes, theta, x, y = bin_values
    for k in range(n - 1, -1, -1):
        turn = abs(best[k, 1] - theta) % (2 * math.pi)
        if (
            min(turn, 2 * math.pi - turn) <= _BESIDE * bins.theta_rad
            and abs(best[k, 2] - x) <= _BESIDE * bins.shift_m
            and abs(best[k, 3] - y) <= _BESIDE * bins.shift_m
        ):
            if best[k, 0] >= votes:
                return n
            for m in range(k, n - 1):
                best[m] = best[m + 1]
            n -= 1
    n = min(n + 1, len(best))
    position = n - 1
    while position > 0 and best[position - 1, 0] < votes:
        best[position] = best[position - 1]
        position -= 1
    best[position, 0], best[position, 1], best[position, 2], best[position, 3] = votes, theta, x, y
    return n


_BESIDE = 4.5  # distance in bins of two bins that may hold votes for one motion


@kernel
def cast_votes(
    sites: tuple[Site, Site],
    of_a: Segments,
    of_b: Segments,
    centre: Float,
    bins: Bins,
    tolerance_m: float,
    size_tolerance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the votes of segments of b, by ascending bin of the angle.

    A vote is the angle of a motion, and the place of `centre` (2,) of map b under it.

    Args:
        sites: both maps.
        of_a: segments of map a in both directions.
        of_b: segments of map b.
        centre: middle of the segments of b.
        bins: widths of the bins.
        tolerance_m: largest difference of two lengths.
        size_tolerance: largest relative difference of two sizes; negative if no landmark has
            attributes.

    Returns:
        Bin of the place of each vote along x and y, shape (V, 2), and the first vote of each bin of
        the angle, shape (n_theta + 1,), the last one V.
    """
    a, b = sites
    end, places = np.zeros(bins.n_theta + 1, np.int64), np.empty((0, 2), np.int32)
    for filled in range(2):  # counts the votes of each angle first
        start = 0
        for f in range(len(of_b.length)):
            length, b_theta, b_rise = of_b.length[f], of_b.theta_rad[f], of_b.rise[f]
            while start < len(of_a.length) and of_a.length[start] < length - tolerance_m:
                start += 1
            bx, by = math.cos(b_theta), math.sin(b_theta)
            mx, my = of_b.middle[f, 0] - centre[0], of_b.middle[f, 1] - centre[1]
            for e in range(start, len(of_a.length)):
                if of_a.length[e] > length + tolerance_m:
                    break
                height_difference = of_a.rise[e] - b_rise
                if height_difference * height_difference > of_a.most_z_m2[e] + of_b.most_z_m2[f]:
                    continue
                if size_tolerance >= 0 and not (
                    attributes_agree(a, b, of_a.ends[e, 0], of_b.ends[f, 0], size_tolerance)
                    and attributes_agree(a, b, of_a.ends[e, 1], of_b.ends[f, 1], size_tolerance)
                ):
                    continue
                theta = of_a.theta_rad[e] - b_theta
                theta += 2 * math.pi if theta < 0 else 0.0
                t = min(int(theta / bins.theta_rad), bins.n_theta - 1)
                if filled:
                    ax, ay = of_a.along[e, 0], of_a.along[e, 1]
                    cos, sin = ax * bx + ay * by, ay * bx - ax * by
                    x = of_a.middle[e, 0] - (cos * mx - sin * my)
                    y = of_a.middle[e, 1] - (sin * mx + cos * my)
                    places[end[t], 0] = math.floor(x / bins.shift_m)
                    places[end[t], 1] = math.floor(y / bins.shift_m)
                end[t] += 1
        if not filled:
            total = 0
            for t in range(bins.n_theta):  # each bin begins where the bin before it ends
                total, end[t] = total + end[t], total
            places = np.empty((total, 2), np.int32)
    first = np.zeros(bins.n_theta + 1, np.int64)
    first[1:] = end[: bins.n_theta]
    return places, first


@kernel
def fullest_bins(places: np.ndarray, first: np.ndarray, bins: Bins, max_bins: int) -> Float:
    """Return the bins with most votes, each counted with its neighbours.

    The votes of three neighbouring angles at a time are counted in hash tables without keys. Places
    that collide share a count, which at worst proposes one more motion.

    Args:
        places: votes of `cast_votes`, shape (V, 2).
        first: first vote of each angle, shape (n_theta + 1,).
        bins: widths of the bins.
        max_bins: largest number of bins.

    Returns:
        Number of votes, theta, x and y of each bin, shape (n, 4).
    """
    n = bins.n_theta
    slots, largest = 1, 0
    for t in range(n):
        largest = max(largest, first[t + 1] - first[t])
    while slots < _SLOTS_A_VOTE * largest:
        slots *= 2
    mask = slots - 1
    counts = np.zeros((3, slots), np.int32)
    best, n_best = np.zeros((max_bins, 4)), 0
    for step in range(-1, n + 1):
        for k in range(first[step % n], first[step % n + 1]):
            counts[step % 3, _slot(places[k, 0], places[k, 1], mask)] += 1
        t = step - 1  # both neighbours of this angle are counted now
        if t < 0:
            continue
        for k in range(first[t], first[t + 1]):
            u, v = places[k, 0], places[k, 1]
            # a bin with few votes of its own is next to a full one, or there is none
            votes_of_bin = counts[t % 3, _slot(u, v, mask)]
            if votes_of_bin < 2 or _SHARE_OF_BIN * votes_of_bin < (
                best[max_bins - 1, 0] if n_best == max_bins else 0
            ):
                continue
            votes = 0
            for du in range(-1, 2):
                for dv in range(-1, 2):
                    slot = _slot(u + du, v + dv, mask)
                    votes += counts[0, slot] + counts[1, slot] + counts[2, slot]
            if n_best == max_bins and votes <= best[max_bins - 1, 0]:
                continue
            middle = ((t + 0.5) * bins.theta_rad, (u + 0.5) * bins.shift_m)
            bin_values = (float(votes), *middle, (v + 0.5) * bins.shift_m)
            n_best = insert_bin(best, n_best, bin_values, bins)
        previous_angle = (t - 1) % n
        for k in range(first[previous_angle], first[previous_angle + 1]):
            counts[(t - 1) % 3, _slot(places[k, 0], places[k, 1], mask)] = 0
    return best[:n_best].copy()


_SLOTS_A_VOTE = 8  # so that few places share a slot
_SHARE_OF_BIN = 27  # a bin and its neighbours; the fullest of them has this share of the votes


_NEIGHBOURS = 8  # nearest landmarks that give the density of a map at a place


@kernel
def near_pairs(
    moved: Float,
    rows_b: np.ndarray,
    sites: tuple[Site, Site],
    near_a: Grid,
    limits: tuple[float, float],
) -> tuple[np.ndarray, Float]:
    """Return landmarks of a near moved landmarks of b, with attributes that agree.

    Args:
        moved: places in frame a, shape (n, 2).
        rows_b: rows of map b at these places, shape (n,).
        sites: both maps.
        near_a: grid over map a.
        limits: largest distance in the plane, and `size_tolerance` of `fullest_bins`.

    Returns:
        Row of a and number of the place of each pair, shape (K, 2), and the distances, shape (K,).
    """
    (a, b), (gate_m, size_tolerance) = sites, limits
    runs = np.empty((near_a.shape[1], 2), np.int64)
    pairs, distances = np.empty((0, 2), np.int64), np.empty(0)
    n = 0
    for filled in range(2):  # counts the pairs first
        n = 0
        for q in range(len(moved)):
            x, y = moved[q, 0], moved[q, 1]
            for run in range(ranges_within(x, y, gate_m, near_a, runs)):
                for k in range(runs[run, 0], runs[run, 1]):
                    dx, dy = near_a.p[k, 0] - x, near_a.p[k, 1] - y
                    square = dx * dx + dy * dy
                    if square > gate_m * gate_m:
                        continue
                    i = near_a.row[k]
                    if size_tolerance >= 0 and not attributes_agree(
                        a, b, i, rows_b[q], size_tolerance
                    ):
                        continue
                    if filled:
                        pairs[n, 0], pairs[n, 1], distances[n] = i, q, math.sqrt(square)
                    n += 1
        if not filled:
            pairs, distances = np.empty((n, 2), np.int64), np.empty(n)
    return pairs, distances


def mutually_nearest(index_a: np.ndarray, index_b: np.ndarray, distance: Float) -> np.ndarray:
    """Mark the pairs (K,) that are nearest for both of their landmarks; they are one to one."""
    order = np.lexsort((index_b, index_a, distance))
    nearest = np.zeros((2, len(order)), np.bool_)
    for k, index in enumerate((index_a, index_b)):
        nearest[k, order[np.unique(index[order], return_index=True)[1]]] = True
    return nearest[0] & nearest[1]


class PlacedSearch:
    """Refits motions to the landmarks that they lay on each other.

    Args:
        a, b: both maps.
        size_tolerance: largest relative difference of two sizes.
    """

    def __init__(self, a: Site, b: Site, size_tolerance: float) -> None:
        self._a, self._b = a, b
        self._size_tolerance = size_tolerance if have_attributes(a, b) else -1.0
        self._tree, self._grid = scipy.spatial.KDTree(a.p), Grid.of(a.p)
        self._has_heights = bool(np.isfinite(a.most_z_m2).all() and np.isfinite(b.most_z_m2).all())

    def _near(self, rows_b: np.ndarray, moved: Float, gate_m: float) -> tuple[np.ndarray, Float]:
        limits = float(gate_m), float(self._size_tolerance)
        return near_pairs(moved, rows_b, (self._a, self._b), self._grid, limits)

    def density(self, moved: Float) -> Float:
        """Return the density of map a in landmarks per square metre at some places (n, 2).

        The nearest neighbours give the density (Loftsgaarden and Quesenberry 1965).
        """
        k = min(_NEIGHBOURS, len(self._a.p))
        radius = self._tree.query(moved, k=[k])[0][:, 0]
        return max(k - 1, 1) / (math.pi * np.maximum(radius, _TINY_M) ** 2)

    def pairs_within(
        self, T_a_b: Float, rows_b: np.ndarray, gate_m: float, up_m: float = math.nan
    ) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Pair the landmarks that a motion lays on each other, each with its nearest one.

        Args:
            T_a_b: motion, shape (3,).
            rows_b: rows of map b that take part, shape (n,).
            gate_m: largest distance in the plane.
            up_m: height of frame b in frame a; NaN to take the one that most pairs share.

        Returns:
            Rows of map a and of map b, one to one (K,); up_m; and the share of pairs whose heights
            agree.
        """
        a, b = self._a, self._b
        neighbours, distance = self._near(rows_b, transform_points(T_a_b, b.p[rows_b]), gate_m)
        i, j, share = neighbours[:, 0], rows_b[neighbours[:, 1]], 1.0
        if len(i) and self._has_heights:
            height_difference, reach2 = a.z[i] - b.z[j], a.most_z_m2[i] + b.most_z_m2[j]
            if math.isnan(up_m):  # median of the densest interval of this length
                length, ordered = 2 * math.sqrt(np.median(reach2)), np.sort(height_difference)
                ends = np.searchsorted(ordered, ordered + length, side="right")
                first = int(np.argmax(ends - np.arange(len(ordered))))
                up_m = float(np.median(ordered[first : ends[first]]))
            agree = (height_difference - up_m) ** 2 <= reach2
            share = (np.count_nonzero(agree) + 1) / (len(i) + 1)
            i, j, distance = i[agree], j[agree], distance[agree]
        is_mutual = mutually_nearest(i, j, distance)
        return i[is_mutual], j[is_mutual], 0.0 if math.isnan(up_m) else up_m, share

    def agreeing(self, rows_b: np.ndarray, moved: Float, gate_m: float, up_m: float) -> np.ndarray:
        """Return True, shape (S,), for landmarks of b that agree with a landmark of a if displaced.

        Args:
            rows_b: rows of map b, shape (S,).
            moved: their displaced places in frame a, shape (S, 2).
            gate_m: largest distance in the plane.
            up_m: height of frame b in frame a.
        """
        a, b = self._a, self._b
        neighbours, _ = self._near(rows_b, moved, gate_m)
        i, j = neighbours[:, 0], rows_b[neighbours[:, 1]]
        agree = (a.z[i] - b.z[j] - up_m) ** 2 <= a.most_z_m2[i] + b.most_z_m2[j]
        agrees = np.zeros(len(rows_b), np.bool_)
        agrees[neighbours[agree, 1]] = True
        return agrees

    def refit(self, T_a_b: Float, centre: Float, reach_m: float, tolerance_m: float) -> Float:
        """Return a motion refitted to its support, which grows from a part of map b.

        The angle of a vote is uncertain. The support is therefore taken within `reach_m` of
        `centre` (2,) at first, and then within twice as much each time.
        """
        T, away = T_a_b.copy(), np.hypot(*(self._b.p - centre).T)
        farthest = float(away.max())
        while True:
            rows = np.flatnonzero(away <= reach_m)
            for gate_m in (2.5 * tolerance_m, 1.5 * tolerance_m, tolerance_m):
                i, j, _, _ = self.pairs_within(T, rows, gate_m)
                if len(i) < 3:
                    return T
                T = fit_plane(self._a.p[i], self._b.p[j])
            if reach_m >= farthest:
                return T
            reach_m *= 2

    def place(self, T_a_b: Float, gates_m: Float) -> Placement:
        """Return the placement of a motion at the gate of largest surprise."""
        rows = np.arange(len(self._b.p))
        density = self.density(transform_points(T_a_b, self._b.p))
        best = Placement(T_a_b, 0.0, gates_m[-1], rows[:0], rows[:0], 0.0)
        for gate_m in gates_m:
            i, j, up_m, share = self.pairs_within(T_a_b, rows, gate_m)
            expected = float(np.minimum(density * math.pi * gate_m**2 * share, 1.0).sum())
            value = surprise(len(i), expected)
            if value > best.surprise:
                best = Placement(T_a_b, up_m, gate_m, i, j, value)
        return best


def surprise(count: int, expected: float) -> float:
    """Return -log of Chernoff's bound of the Poisson probability of `count` or more; 0 below."""
    if count <= expected:
        return 0.0
    return count * math.log(count / expected) - count + expected


def fit_plane(p_a: Float, p_b: Float) -> Float:
    """Return the least-squares motion (3,) of paired points (K, 2)."""
    return np.array(fit_rigid(p_a, p_b, np.arange(len(p_a))))


def attributes_of_pairs_agree(
    a: Site, b: Site, i: np.ndarray, j: np.ndarray, size_tolerance: float
) -> np.ndarray:
    """Return `attributes_agree` of pairs (K,)."""
    unlike = (a.category[i] >= 0) & (b.category[j] >= 0) & (a.category[i] != b.category[j])
    size_difference = np.abs(a.size_m[i] - b.size_m[j])
    return ~unlike & ~(size_difference > size_tolerance * np.fmax(a.size_m[i], b.size_m[j]))


_CANDIDATES = 48  # bins that are refitted
_OF_PART = 6  # bins of each of several parts of map b
_BIN_SHIFT = 1.0  # width of a bin in tolerances; neighbouring bins are counted together
_BIN_ANGLE = 2.0  # width in tolerances over the longest segment
_LEAST_LANDMARKS = 3  # of a map; fewer cannot contradict a motion
_TRUE_WITHIN = 0.99  # probability that a common pair lies within the stated tolerance
_WIDER = 1.5  # ratio of tolerances that differ


def parts_of(segments: Segments, longest_m: float) -> list[tuple[np.ndarray, Float]]:
    """Divide segments by their midpoints into parts of a size that suits their angles.

    Returns the rows and the centre of each part.
    """
    low, high = segments.middle.min(axis=0), segments.middle.max(axis=0)
    shape = np.maximum(np.ceil((high - low) / (2 * longest_m)).astype(np.int64), 1)
    side = np.maximum((high - low) / shape, np.finfo(np.float64).tiny)
    cell = np.minimum(((segments.middle - low) / side).astype(np.int64), shape - 1)
    number = cell[:, 0] * shape[1] + cell[:, 1]
    order = np.argsort(number, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(number[order])) + 1)
    return [(np.sort(rows), segments.middle[rows].mean(axis=0)) for rows in groups]


N_MOTIONS = 4  # motions of which pairs are offered: the best one and its rivals
# Motions with a smaller RMS distance of the moved landmarks count as equal: twice the largest error
# of a correct alignment.
DISTINCT_M = 1.0
_GATES = np.array([0.25, 0.5, 1.0, 2.0])  # gates of a motion's support, in tolerances


def find_placements(a: Site, b: Site, tolerance_m: float, size_tolerance: float) -> list[Placement]:
    """Find placements of map b on map a, of largest surprise first.

    Args:
        a: map in frame a.
        b: map in frame b.
        tolerance_m: distance in the plane within which common landmarks agree.
        size_tolerance: largest relative difference of two sizes.
    """
    if min(len(a.p), len(b.p)) < _LEAST_LANDMARKS:
        return []
    shortest, longest = segment_lengths(a, b, tolerance_m)
    of_a = both_directions(segments_of(a, shortest, longest))
    of_b = segments_of(b, shortest, longest)
    if not len(of_a.length) or not len(of_b.length):
        return []
    n_theta = math.ceil(2 * math.pi / min(_BIN_ANGLE * tolerance_m / longest, math.pi / 8))
    bins = Bins(2 * math.pi / n_theta, _BIN_SHIFT * tolerance_m, n_theta)
    off_m = math.sqrt(2) * tolerance_m  # largest difference of two lengths
    parts, proposed = parts_of(of_b, longest), []
    max_candidates = _CANDIDATES if len(parts) == 1 else _OF_PART
    sizes = size_tolerance if have_attributes(a, b) else -1.0
    for rows, centre in parts:
        segments = Segments(*(part[rows] for part in of_b))
        reach_m = float(np.hypot(*(segments.middle - centre).T).max()) + longest / 2
        places, first = cast_votes((a, b), of_a, segments, centre, bins, off_m, sizes)
        for votes, theta, x, y in fullest_bins(places, first, bins, max_candidates):
            T_a_b = np.array([x, y, theta])
            T_a_b[:2] -= rotation(theta) @ centre
            proposed.append((votes, T_a_b, centre, reach_m))
    proposed.sort(key=lambda each: -each[0])
    search, placements = PlacedSearch(a, b, size_tolerance), list[Placement]()
    for _, T_a_b, centre, reach_m in proposed[:_CANDIDATES]:
        T_a_b = search.refit(T_a_b, centre, reach_m, tolerance_m)
        placements.append(search.place(T_a_b, tolerance_m * _GATES))
    return distinct_placements(placements, b.p)


def distinct_placements(placements: Sequence[Placement], p_b: Float) -> list[Placement]:
    """Return the distinct placements of map b (N, 2) of largest surprise, best first."""
    distinct = list[Placement]()
    for each in sorted(placements, key=lambda each: -each.surprise):
        apart = (rms_distance_m(each.T_a_b, other.T_a_b, p_b) for other in distinct)
        if each.surprise > 0 and all(distance_m >= DISTINCT_M for distance_m in apart):
            distinct.append(each)
    return distinct[:N_MOTIONS]


def match_by_geometry(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    height_bound: float,
    floor_m2: float,
    tolerance_m: float,
    size_tolerance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs (K,) of landmarks that the best motions lay on each other.

    Args:
        map_a: map in frame a.
        map_b: map in frame b.
        height_bound: see `Site.of`.
        floor_m2: see `Site.of`.
        tolerance_m: distance in the plane within which common landmarks agree. If the covariances
            of the maps state more, this is tried as well.
        size_tolerance: largest relative difference of two sizes.
    """
    a, b = (Site.of(each, height_bound, floor_m2) for each in (map_a, map_b))
    tolerances = [tolerance_m]
    if len(a.p) and len(b.p):
        variances = (np.median(each.covariance_m2[:, [0, 1], [0, 1]]) for each in (map_a, map_b))
        stated_m = math.sqrt(chi_square_bound(_TRUE_WITHIN, 2) * float(sum(variances)))
        tolerances += [stated_m] if stated_m > _WIDER * tolerance_m else []
    placed_pairs = [
        placement
        for each_m in tolerances
        for placement in find_placements(a, b, each_m, size_tolerance)
    ]
    pairs = np.concatenate(
        [np.zeros((0, 2), np.int64)]
        + [
            np.column_stack([each.index_a, each.index_b])
            for each in distinct_placements(placed_pairs, b.p)
        ]
    )
    index_a, index_b = np.unique(pairs, axis=0).T
    return index_a, index_b
