import numpy as np
import pytest

from mapfusion.fastslam.resampling import effective_sample_size, normalised, systematic_ancestors


def test_normalised_weights_sum_to_one_where_plain_ones_underflow():
    log_weights, log_sum = normalised(np.array([-2000.0, -2000.0 + np.log(3.0)]))
    np.testing.assert_allclose(np.exp(log_weights), [0.25, 0.75])
    assert log_sum == pytest.approx(-2000.0 + np.log(4.0))


@pytest.mark.parametrize(
    ("weights", "expected"),
    [([0.25] * 4, 4.0), ([1.0, 0.0, 0.0], 1.0), ([0.5, 0.5, 0.0], 2.0), ([0.8, 0.2], 1 / 0.68)],
)
def test_effective_sample_size(weights, expected):
    with np.errstate(divide="ignore"):
        assert effective_sample_size(np.log(weights)) == pytest.approx(expected)


def test_children_number_within_one_of_their_share_and_on_average_exactly():
    rng = np.random.default_rng(3)
    weights = rng.dirichlet(np.full(20, 0.3))
    n_draws = 20_000
    total = np.zeros(20)
    for _ in range(n_draws):
        ancestors = systematic_ancestors(np.log(weights), rng)
        children = np.bincount(ancestors, minlength=20)
        assert np.all(np.abs(children - 20 * weights) < 1)
        assert np.all(np.diff(ancestors) >= 0)
        total += children
    # The share left after whole children is a coin of variance at most 1/4; five deviations.
    np.testing.assert_allclose(total / n_draws, 20 * weights, atol=5 * 0.5 / np.sqrt(n_draws))


def test_equal_weights_keep_everybody():
    rng = np.random.default_rng(0)
    for n in (1, 7, 200):
        for _ in range(50):
            ancestors = systematic_ancestors(np.full(n, -np.log(n)), rng)
            assert 0 in ancestors
            assert len(np.unique(ancestors)) >= n - 1


def test_the_heaviest_always_has_a_child():
    rng = np.random.default_rng(1)
    for _ in range(300):
        log_weights, _ = normalised(rng.normal(0, rng.choice([1e-17, 1e-3, 10.0]), 33))
        assert np.argmax(log_weights) in systematic_ancestors(log_weights, rng)
