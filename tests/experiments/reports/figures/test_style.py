"""Tests of floor plans and of the common style."""

import io

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from experiments.reports.figures import style
from experiments.reports.figures.style import write_plainly
from mapfusion.plotting import add_ellipses, ellipse_handle, semi_axes


def test_strays_are_out_of_view_and_counted() -> None:
    """1000 landmarks over 10 m, two of them far off; the path is shown whole."""
    rng = np.random.default_rng(0)
    landmarks = rng.uniform(0, 10, (1000, 3))
    landmarks[:2, :2] = [[100.0, 5.0], [5.0, -80.0]]
    axes = Figure().subplots()
    assert style.set_view(axes, landmarks, np.zeros((0, 2))) == "1000 landmarks, 2 out of view"
    assert axes.get_xlim() == pytest.approx((-0.5, 10.5), abs=0.1)
    assert axes.get_ylim() == pytest.approx((-0.5, 10.5), abs=0.1)
    assert axes.get_aspect() == 1.0
    path = np.array([[5.0, 5.0], [30.0, 5.0], [np.nan, np.nan]])
    assert style.set_view(axes, landmarks[2:], path) == "998 landmarks"
    assert axes.get_xlim() == pytest.approx((-1.5, 31.5), abs=0.1)


def test_of_a_house_much_larger_than_its_map_the_surroundings_are_shown() -> None:
    """A map of 10 m in a house of 400 m is shown with 10 m around it, or up to a nearer wall."""
    landmarks = np.array([[0.0, 0.0, 1.0], [10.0, 2.0, 1.0]])
    landmarks = np.repeat(landmarks, 300, axis=0)  # no stray
    house = [np.array([[-200.0, -3.0], [200.0, -3.0]]), np.array([[-200.0, 50.0], [200.0, 50.0]])]
    axes = Figure().subplots()
    assert style.set_view(axes, landmarks, np.zeros((0, 2)), house) == "600 landmarks"
    margin = 0.05 * 30
    assert axes.get_xlim() == pytest.approx((-10 - margin, 20 + margin))
    assert axes.get_ylim() == pytest.approx((-3 - margin, 12 + margin))
    style.set_view(axes, landmarks[:0], np.zeros((0, 2)), house)
    assert axes.get_xlim() == pytest.approx((-220, 220))


def test_nothing_to_see_has_a_view_too() -> None:
    axes = Figure().subplots()
    assert style.set_view(axes, np.zeros((0, 3)), np.zeros((0, 2))) == "0 landmarks"
    assert axes.get_xlim() == axes.get_ylim() == pytest.approx((-0.3, 0.3))


def test_a_row_is_as_high_as_its_highest_panel_needs() -> None:
    wide, high = Figure().subplots(1, 2)
    style.set_square(wide, np.array([3.0, -1.0]), 2.0)
    assert (wide.get_xlim(), wide.get_ylim()) == ((1.0, 5.0), (-3.0, 1.0))
    high.set(xlim=(0, 2), ylim=(0, 3))
    # labels take 0.55 in beside and 0.65 in below a panel
    assert style.height_of_row([wide, high], 3.55) == pytest.approx(1.5 * 3.0 + 0.65)
    assert style.height_of_row([wide], 3.55) == pytest.approx(3.0 + 0.65)


def test_axes_tell_unit_and_frame_and_the_start_pose_is_drawn() -> None:
    axes = Figure().subplots()
    style.label_plan(axes, "R2")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x in R2's frame (m)", "y in R2's frame (m)")
    style.add_frame(axes, 2.0)
    tips = [text.xy for text in axes.texts]
    assert tips == [(2.0, 0.0), (2.0, 0.0), (0.0, 2.0), (0.0, 2.0)]
    style.add_points(axes, np.array([[1.0, 2.0, 9.0], [3.0, 4.0, 9.0]]), marker=".", color="b")
    (points,) = axes.get_lines()
    np.testing.assert_array_equal(points.get_xydata(), [[1, 2], [3, 4]])
    assert points.get_rasterized()


def test_a_legend_says_the_ellipses_level() -> None:
    handle = ellipse_handle("#112233")
    assert handle.get_label() == "95 % ellipses, to scale"
    assert to_hex(handle.get_color()) == "#112233"


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


def labels_between_powers(least: float, most: float) -> list[str]:
    """Return the tick labels of an axis with these ends, without empty ones."""
    figure = Figure()
    axes = figure.subplots()
    axes.set_yscale("log")
    write_plainly(axes.yaxis)
    axes.set_ylim(least, most)
    FigureCanvasAgg(figure).draw()
    assert "0.001" in [label.get_text() for label in axes.yaxis.get_majorticklabels()]
    return [text for label in axes.yaxis.get_minorticklabels() if (text := label.get_text())]


def test_an_axis_of_few_powers_of_ten_has_plain_numbers_between_them() -> None:
    labels = labels_between_powers(2e-4, 9e-3)
    assert {"0.0003", "0.002"} <= set(labels)
    assert all(2e-4 <= float(label) <= 9e-3 and "e" not in label for label in labels)


def test_an_axis_of_many_powers_has_none_between_them() -> None:
    assert labels_between_powers(1e-4, 10) == []
