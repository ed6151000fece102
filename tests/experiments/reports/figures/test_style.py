"""The house style: numbers of logarithmic axes."""

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.reports.figures.style import write_plainly


def labels_between_powers(least: float, most: float) -> list[str]:
    """Of an axis with these ends, where there are any."""
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
