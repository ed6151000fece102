"""What plans show and how large they are, read back from the axes."""

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from experiments.reports.figures import floor_plan


def test_strays_are_out_of_view_and_counted() -> None:
    """1000 landmarks over 10 m, two of them far off; the path is shown whole."""
    rng = np.random.default_rng(0)
    landmarks = rng.uniform(0, 10, (1000, 3))
    landmarks[:2, :2] = [[100.0, 5.0], [5.0, -80.0]]
    axes = Figure().subplots()
    assert floor_plan.set_view(axes, landmarks, np.zeros((0, 2))) == "1000 landmarks, 2 out of view"
    assert axes.get_xlim() == pytest.approx((-0.5, 10.5), abs=0.1)
    assert axes.get_ylim() == pytest.approx((-0.5, 10.5), abs=0.1)
    assert axes.get_aspect() == 1.0
    path = np.array([[5.0, 5.0], [30.0, 5.0], [np.nan, np.nan]])
    assert floor_plan.set_view(axes, landmarks[2:], path) == "998 landmarks"
    assert axes.get_xlim() == pytest.approx((-1.5, 31.5), abs=0.1)


def test_of_a_house_much_larger_than_its_map_the_surroundings_are_shown() -> None:
    """A map of 10 m by 2 m in a house of 400 m: 10 m around it; and to a wall that is nearer."""
    landmarks = np.array([[0.0, 0.0, 1.0], [10.0, 2.0, 1.0]])
    landmarks = np.repeat(landmarks, 300, axis=0)  # no stray
    house = [np.array([[-200.0, -3.0], [200.0, -3.0]]), np.array([[-200.0, 50.0], [200.0, 50.0]])]
    axes = Figure().subplots()
    assert floor_plan.set_view(axes, landmarks, np.zeros((0, 2)), house) == "600 landmarks"
    margin = 0.05 * 30
    assert axes.get_xlim() == pytest.approx((-10 - margin, 20 + margin))
    assert axes.get_ylim() == pytest.approx((-3 - margin, 12 + margin))
    floor_plan.set_view(axes, landmarks[:0], np.zeros((0, 2)), house)
    assert axes.get_xlim() == pytest.approx((-220, 220))


def test_nothing_to_see_has_a_view_too() -> None:
    axes = Figure().subplots()
    assert floor_plan.set_view(axes, np.zeros((0, 3)), np.zeros((0, 2))) == "0 landmarks"
    assert axes.get_xlim() == axes.get_ylim() == pytest.approx((-0.3, 0.3))


def test_a_row_is_as_high_as_its_highest_panel_needs() -> None:
    wide, high = Figure().subplots(1, 2)
    floor_plan.set_square(wide, np.array([3.0, -1.0]), 2.0)
    assert (wide.get_xlim(), wide.get_ylim()) == ((1.0, 5.0), (-3.0, 1.0))
    high.set(xlim=(0, 2), ylim=(0, 3))
    # labels take 0.55 in beside and 0.65 in below a panel
    assert floor_plan.height_of_row([wide, high], 3.55) == pytest.approx(1.5 * 3.0 + 0.65)
    assert floor_plan.height_of_row([wide], 3.55) == pytest.approx(3.0 + 0.65)


def test_axes_tell_unit_and_frame_and_the_start_pose_is_drawn() -> None:
    axes = Figure().subplots()
    floor_plan.label_plan(axes, "R2")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x in R2's frame (m)", "y in R2's frame (m)")
    floor_plan.add_frame(axes, 2.0)
    tips = [text.xy for text in axes.texts]
    assert tips == [(2.0, 0.0), (2.0, 0.0), (0.0, 2.0), (0.0, 2.0)]
    floor_plan.add_points(axes, np.array([[1.0, 2.0, 9.0], [3.0, 4.0, 9.0]]), marker=".", color="b")
    (points,) = axes.get_lines()
    np.testing.assert_array_equal(points.get_xydata(), [[1, 2], [3, 4]])
    assert points.get_rasterized()


def test_a_legend_says_the_ellipses_level() -> None:
    handle = floor_plan.ellipse_handle("#112233")
    assert handle.get_label() == "95 % ellipses, to scale"
    assert to_hex(handle.get_color()) == "#112233"
