"""SVD: one linear least squares over all correspondences (algorithm 1)."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from mapfusion.align.alignment import MIN_PAIRS, Fit, Needs, Pairs, Undetermined
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import rotation

Translation = Literal["printed", "solved"]
Points = Literal["plane", "space"]
_COORDINATES: dict[Points, int] = {"plane": 2, "space": 3}


@dataclass(frozen=True)
class Svd:
    """Algorithm 1: affine least squares |T m' - m| over all pairs, by pseudo-inverse.

    m and m' are homogeneous points, one pair per row. The linear part of T is any matrix; theta is
    the angle of the rotation nearest to its block of x and y. False pairs have full weight. Noise
    in m' shrinks the linear part and biases the printed translation.

    Attributes:
        translation: "printed" is the last column of T, as in the paper; "solved" aligns the
            centroids under theta.
        points: "plane" uses (x, y, 1) and a 3x3 matrix T; "space" uses (x, y, z, 1) and the 4x4
            matrix T of eq. 11. Planar maps always use the plane.
    """

    randomised: ClassVar[bool] = False
    needs: ClassVar[Needs] = Needs(MIN_PAIRS, dimensions=2)
    translation: Translation = "printed"
    points: Points = "plane"

    def __post_init__(self) -> None:
        for name, options in (("translation", Translation), ("points", Points)):
            if (value := getattr(self, name)) not in get_args(options):
                known_text = ", ".join(get_args(options))
                raise ValueError(f"{name}: is {value!r}, expected one of {known_text}")

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """Fit T_a_b to all pairs; `rng` is not used."""
        del rng
        n = _COORDINATES["plane" if pairs.planar else self.points]
        if len(pairs) <= n:
            return Undetermined(f"{len(pairs)} pairs leave a row of {n + 1} entries of T open")
        T_a_b, gain = solve(pairs.p_a[:, :2], pairs.p_b[:, :n], self.translation)
        return Fit(T_a_b, np.ones(len(pairs), dtype=bool), gain=gain)


def solve(m: Float, m_prime: Float, translation: Translation) -> tuple[Float, Float]:
    """Solve algorithm 1 for points of frames a and b, shapes (N, 2) and (N, D); D is 2 or 3.

    The steps z = u' m, w = z / sv, T = (v w)' of the paper are the pseudo-inverse of m' times m.
    Each row of T depends on one coordinate of m, and the motion needs those of x and y only.

    Returns:
        tx, ty, theta, shape (3,), and their derivatives by each residual, shape (N, 3, 2).
    """
    inverse = np.linalg.pinv(np.hstack([m_prime, np.ones((len(m), 1))]))
    T = (inverse @ m).T
    A, B = T[0, 0] + T[1, 1], T[1, 0] - T[0, 1]
    theta = math.atan2(B, A)
    gain = np.zeros((len(m), 3, 2))
    gain[:, 2] = (inverse[:2].T @ [[-B, A], [-A, -B]]) / (A * A + B * B)
    if translation == "printed":
        t = T[:2, -1]
        gain[:, :2] = inverse[-1][:, None, None] * np.eye(2)
    else:
        turned = rotation(theta) @ m_prime[:, :2].mean(axis=0)
        t = m.mean(axis=0) - turned
        lever = np.array([turned[1], -turned[0]])  # -d turned / d theta
        gain[:, :2] = np.eye(2) / len(m) + lever[:, None] * gain[:, 2:]
    return np.array([t[0], t[1], theta]), gain
