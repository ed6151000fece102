"""SVD: one linear least squares over all correspondences (algorithm 1)."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from mapfusion.align.alignment import MIN_PAIRS, Fit, Needs, Pairs
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import rotation

Translation = Literal["printed", "solved"]


@dataclass(frozen=True)
class Svd:
    """Algorithm 1: affine least squares |T m' - m| over all pairs, by pseudo-inverse.

    m and m' are homogeneous points of the plane, one pair per row. The linear part of T is any 2x2
    matrix; theta is the angle of the nearest rotation. False pairs have full weight. Noise in m'
    shrinks the linear part and biases the printed translation.

    Attributes:
        translation: "printed" is the last column of T, as in the paper; "solved" aligns the
            centroids under theta.
    """

    randomised: ClassVar[bool] = False
    needs: ClassVar[Needs] = Needs(MIN_PAIRS, dimensions=2)
    translation: Translation = "printed"

    def __post_init__(self) -> None:
        if self.translation not in get_args(Translation):
            known = ", ".join(get_args(Translation))
            raise ValueError(f"translation: is {self.translation!r}, expected one of {known}")

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit:
        """Fit T_a_b to all pairs; `rng` is not used."""
        del rng
        T_a_b, gain = solve(pairs.p_a[:, :2], pairs.p_b[:, :2], self.translation)
        return Fit(T_a_b, np.ones(len(pairs), dtype=bool), gain=gain)


def solve(m: Float, m_prime: Float, translation: Translation) -> tuple[Float, Float]:
    """Solve algorithm 1 for points (N, 2) of frames a and b.

    The steps z = u' m, w = z / sv, T = (v w)' of the paper are the pseudo-inverse of m' times m.

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
        t = T[:2, 2]
        gain[:, :2] = inverse[2][:, None, None] * np.eye(2)
    else:
        turned = rotation(theta) @ m_prime.mean(axis=0)
        t = m.mean(axis=0) - turned
        lever = np.array([turned[1], -turned[0]])  # -d turned / d theta
        gain[:, :2] = np.eye(2) / len(m) + lever[:, None] * gain[:, 2:]
    return np.array([t[0], t[1], theta]), gain
