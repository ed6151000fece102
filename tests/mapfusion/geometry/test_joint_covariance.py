"""Block diagonal plus low rank, against the dense covariance that it stands for."""

import numpy as np
import pytest

from mapfusion.geometry import joint_covariance
from mapfusion.geometry.joint_covariance import (
    JointCovariance,
    KnownErrors,
    StackedErrors,
    reduce_rank,
)


def _parts(
    rng: np.random.Generator, n: int, variances: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Own blocks, and a common part whose directions have these variances."""
    rotation = np.linalg.qr(rng.normal(size=(len(variances), len(variances))))[0]
    across = np.linalg.qr(rng.normal(size=(3 * n, len(variances))))[0].T
    root = rng.normal(size=(n, 3, 3))
    return root @ np.swapaxes(root, 1, 2), rotation @ (np.sqrt(variances)[:, None] * across)


def _dense(own_m2: np.ndarray, common: np.ndarray) -> np.ndarray:
    joint = common.T @ common
    for k, block in enumerate(own_m2):
        joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += block
    return joint


def test_all_directions_kept_are_the_dense_covariance() -> None:
    own, common = _parts(np.random.default_rng(0), 7, np.geomspace(1, 1e-3, 12))
    joint = reduce_rank(own, common, rank=12)
    np.testing.assert_allclose(joint.dense_m2(), _dense(own, common), rtol=0, atol=1e-12)


@pytest.mark.parametrize("rank", [5, 20])
@pytest.mark.parametrize("few", [0, 720])
def test_what_is_left_out_is_the_smallest_and_goes_to_the_landmarks_own(
    monkeypatch: pytest.MonkeyPatch, rank: int, few: int
) -> None:
    monkeypatch.setattr(joint_covariance, "_FEW", few)
    variances = np.geomspace(1, 1e-6, 60)
    own, common = _parts(np.random.default_rng(1), 40, variances)
    joint, whole = reduce_rank(own, common, rank), _dense(own, common)
    assert joint.rank == rank
    blocks = whole.reshape(40, 3, 40, 3)[np.arange(40), :, np.arange(40)]
    np.testing.assert_allclose(joint.marginal_m2, blocks, rtol=0, atol=1e-12)
    # Eckart and Young: nothing of that rank can be closer than the next variance
    stacked = joint.common_m.transpose(1, 0, 2).reshape(rank, -1)
    off = np.linalg.norm(common.T @ common - stacked.T @ stacked, ord=2)
    assert off == pytest.approx(variances[rank], rel=1e-3)
    assert np.all(np.linalg.eigvalsh(joint.own_m2 - own) > -1e-12)


@pytest.mark.parametrize("near", [1.0, 1e-3, 1e-5, 1e-9, 0.0])
def test_columns_become_orthonormal_however_near_to_each_other(near: float) -> None:
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(200, 1)) + near * rng.normal(size=(200, 12))
    columns *= np.geomspace(1, 1e-9, 12)
    basis = joint_covariance._orthonormal(columns)
    np.testing.assert_allclose(basis.T @ basis, np.eye(12), rtol=0, atol=1e-12)
    left = columns - basis @ (basis.T @ columns)
    assert np.all(np.linalg.norm(left, axis=0) < 1e-12 * np.linalg.norm(columns, axis=0))


def test_rows_are_those_of_the_dense_covariance() -> None:
    own, common = _parts(np.random.default_rng(2), 6, np.ones(4))
    joint, rows = reduce_rank(own, common), np.array([4, 1])
    of = (3 * rows[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose(joint[rows].dense_m2(), _dense(own, common)[np.ix_(of, of)])


def test_stacked_errors_are_those_of_all_rows() -> None:
    rng = np.random.default_rng(4)
    Y, columns = rng.normal(size=(9, 15)), rng.normal(size=(9, 2))
    stacked = StackedErrors(KnownErrors(Y[:5]), KnownErrors(Y[5:]))
    rows = np.array([7, 1])
    np.testing.assert_allclose(stacked.rows_by_all(rows), (Y @ Y.T)[:, rows])
    np.testing.assert_allclose(stacked.gram(columns), Y @ Y.T @ columns)
    np.testing.assert_allclose(stacked.spread(columns), Y.T @ columns)
    np.testing.assert_allclose(stacked.gathered(Y.T @ columns), Y @ Y.T @ columns)
    np.testing.assert_allclose(stacked.squares(), KnownErrors(Y).squares())


def test_parts_of_different_landmarks_are_refused() -> None:
    with pytest.raises(ValueError, match="common_m"):
        JointCovariance(np.zeros((2, 3, 3)), np.zeros((3, 1, 3)))
