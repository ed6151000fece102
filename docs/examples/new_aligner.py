"""A new aligner beside RANSAC.

The new method trusts the half of the pairs whose descriptors are nearest to each other. `estimated`
is its own answer, before the least-squares refinement that all methods share. The true `T_a_b` is
(2, 1, 0).
"""

import matplotlib.pyplot as plt
import numpy as np

import mapfusion
from mapfusion.align.alignment import supported
from mapfusion.align.rigid_motion import fit_rigid


class Nearest:
    """Closed-form motion of the half of the pairs with the nearest descriptors."""

    randomised = False

    def find(self, pairs, rng):
        """Return the motion and the pairs that support it."""
        nearest = pairs.distance <= np.median(pairs.distance)
        T_a_b = fit_rigid(pairs.p_a, pairs.p_b, np.flatnonzero(nearest))
        return supported(pairs, nearest, np.array(T_a_b))


def error_m(aligner, noise, seed):
    """Return the translation error of an aligner on two maps with noisy descriptors."""
    rng = np.random.default_rng(seed)
    points, descriptors = rng.uniform(0, 20, (60, 2)), rng.standard_normal((60, 16))
    maps = []
    for start in ([0, 0], [2, 1]):
        seen = points - start + rng.normal(0, 0.02, (60, 2))
        observed = descriptors + rng.normal(0, noise, descriptors.shape)
        observed /= np.linalg.norm(observed, axis=1, keepdims=True)
        position_m = np.column_stack([seen, np.zeros(60)])
        covariance_m2 = np.tile(np.eye(3) * 0.02**2, (60, 1, 1))
        count, source = np.ones(60, np.int32), np.arange(60)
        appearance = {"descriptor": observed.astype(np.float32), "planar": True}
        maps.append(mapfusion.LandmarkMap(position_m, covariance_m2, count, source, **appearance))
    map_a, map_b = maps
    pairs = mapfusion.match(map_a, map_b)
    registration = mapfusion.Registration(aligner)
    found = registration.register(map_a, map_b, pairs, np.random.default_rng(seed)).estimated
    return np.hypot(*(found.T_a_b[:2] - [2, 1]))


noises = (0.1, 0.3, 0.5, 0.7)
figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
for name, aligner in {"ransac": mapfusion.make_aligner("ransac"), "Nearest": Nearest()}.items():
    errors = [np.median([error_m(aligner, noise, seed) for seed in range(5)]) for noise in noises]
    print(name, *(f"{error:.3f} m" for error in errors))
    axes.semilogy(noises, errors, "o-", label=name)
axes.set(xlabel="noise of the descriptors", ylabel="median translation error [m]")
axes.legend()
figure.savefig("picture.png", dpi=100)
