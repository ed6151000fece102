import io

import numpy as np
import pytest
from matplotlib.figure import Figure

from experiments.reports.figures.floor_plan import add_ellipses, semi_axes

LEVEL = 0.95
# Chi-square with two degrees of freedom is an exponential: its quantile needs no table.
QUANTILE = -2 * np.log(1 - LEVEL)


def covariance(major: float, minor: float, angle: float) -> np.ndarray:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn @ np.diag([major**2, minor**2]) @ turn.T


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2, 2.5, -1.2])
def test_axes_are_the_standard_deviations_times_the_root_of_the_quantile(angle: float) -> None:
    major, minor, direction = semi_axes(covariance(0.3, 0.1, angle)[None], LEVEL)
    assert major[0] == pytest.approx(0.3 * np.sqrt(QUANTILE), rel=1e-12)
    assert minor[0] == pytest.approx(0.1 * np.sqrt(QUANTILE), rel=1e-12)
    assert np.cos(2 * (direction[0] - angle)) == pytest.approx(1.0, abs=1e-12)  # modulo pi


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_ellipse_holds_its_share_of_normal_points(level: float) -> None:
    rng = np.random.default_rng(1)
    S = covariance(0.4, 0.07, 0.7)
    points = rng.multivariate_normal([0, 0], S, size=20_000)
    major, minor, direction = semi_axes(S[None], level)
    along = np.array([np.cos(direction[0]), np.sin(direction[0])])
    across = np.array([-along[1], along[0]])
    inside = ((points @ along) / major) ** 2 + ((points @ across) / minor) ** 2 <= 1
    four_sigma = 4 * np.sqrt(level * (1 - level) / len(points))
    assert inside.mean() == pytest.approx(level, abs=four_sigma)


def test_singular_covariance_gives_a_line_and_no_nan() -> None:
    major, minor, _ = semi_axes(np.array([[[1.0, 1.0], [1.0, 1.0]]]), LEVEL)
    assert minor[0] == pytest.approx(0.0, abs=1e-6)
    assert major[0] == pytest.approx(np.sqrt(2 * QUANTILE))


def test_ellipses_are_drawn_to_scale_at_their_place() -> None:
    figure = Figure(figsize=(4, 4), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set_xlim(-2, 2)
    axes.set_ylim(-2, 2)  # 100 pixels a metre
    S = np.zeros((1, 3, 3))
    S[0, :2, :2] = covariance(0.5, 0.2, np.pi / 2)
    add_ellipses(axes, np.array([[0.5, -0.3, 7.0]]), S, edgecolors="black", linewidths=0.5)
    picture = io.BytesIO()
    figure.savefig(picture, format="rgba", dpi=100)
    dark = np.frombuffer(picture.getvalue(), np.uint8).reshape(400, 400, 4)[..., 0] < 200
    rows, columns = np.nonzero(dark)
    half_x, half_y = 20 * np.sqrt(QUANTILE), 50 * np.sqrt(QUANTILE)
    tolerance_px = 1.5
    assert columns.min() == pytest.approx(250 - half_x, abs=tolerance_px)
    assert columns.max() == pytest.approx(250 + half_x, abs=tolerance_px)
    assert rows.min() == pytest.approx(230 - half_y, abs=tolerance_px)
    assert rows.max() == pytest.approx(230 + half_y, abs=tolerance_px)
