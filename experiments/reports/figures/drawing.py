"""All figures of a result, each from stored tables and key frames alone."""

import importlib
import io
import re
from collections.abc import Callable
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, NamedTuple

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.pipeline.workers import Workers, workers
from experiments.reports.figures.result_tables import NothingToDraw, ResultTables
from experiments.reports.figures.style import house_style
from mapfusion.files import write_whole

# Each is a module `figNN_NAME` with a function `draw`; its docstring is the caption, and `READS`
# names what it takes of a result: tables, and `scenario`.
_MODULES = iter_modules([str(Path(__file__).parent)])
FIGURES = tuple(sorted(each.name for each in _MODULES if re.match(r"fig\d\d_", each.name)))
# An SVG's are of the parts that are drawn as pixels, which make up most of the file.
_DPI = {"png": 200, "svg": 150}
# No date: the same tables give the same bytes. PNG are packed faster than by default, and larger.
_SAVED = {"png": {"pil_kwargs": {"compress_level": 2}}, "svg": {"metadata": {"Date": None}}}


class Drawn(NamedTuple):
    """The pictures written, and one line each which figures there is no data for, and why."""

    files: list[Path]
    skipped: list[str]


class Drawing:
    """The figures of one result, each drawn by a pool as soon as all that it reads is written."""

    def __init__(self, pool: Workers) -> None:
        self._pool = pool
        self._written: set[str] = set()
        self._begun: set[str] = set()

    def written(self, result: Path, part: str) -> None:
        """A part of a result is there: a table, or `scenario`."""
        self._written.add(part)
        for name in FIGURES:
            if name not in self._begun and self._written.issuperset(_module(name).READS):
                self._begin(name, result)

    def _begin(self, name: str, result: Path) -> None:
        self._begun.add(name)
        self._pool.submit(
            name, draw_figure, ResultTables(result, written=_module(name).READS), name
        )

    def finish(self, result: Path, on_progress: Callable[[int, int], None] | None = None) -> Drawn:
        """Draw those too of which nobody said that what they read is written.

        `on_progress` is told (figures done, figures in all) after each. Returns what was drawn in
        the order of the figures; raises InputError where a table is missing or damaged.
        """
        for name in FIGURES:
            if name not in self._begun:
                self._begin(name, result)
        outcomes: dict[str, Drawn] = {}
        for name, outcome in self._pool.completed():
            outcomes[name] = outcome
            if on_progress is not None:
                on_progress(len(outcomes), len(FIGURES))
        drawn = [outcomes[name] for name in FIGURES]
        files = [file for each in drawn for file in each.files]
        return Drawn(files, [line for each in drawn for line in each.skipped])


def draw_all(
    result: Path, jobs: int = 2, on_progress: Callable[[int, int], None] | None = None
) -> Drawn:
    """Draw all figures of a result folder into `RESULT/figures/`, in `jobs` processes.

    Else as `Drawing.finish`.
    """
    with workers(jobs) as pool:
        return Drawing(pool).finish(result, on_progress)


def draw_figure(data: ResultTables, name: str, folder: Path | None = None) -> Drawn:
    """Draw one of `FIGURES` into a folder, by default `figures` in the result's.

    Old pictures of it are removed where there is nothing to draw.
    """
    folder = folder or data.folder / "figures"
    try:
        return Drawn(save_figure(folder, name, _module(name).draw, data), [])
    except NothingToDraw as reason:
        for kind in _DPI:
            (folder / f"{name}.{kind}").unlink(missing_ok=True)
        return Drawn([], [f"{name}: {reason}"])


def _module(name: str) -> Any:
    return importlib.import_module(f"experiments.reports.figures.{name}")


def save_figure(folder: Path, name: str, draw: Callable[..., Figure], *data: Any) -> list[Path]:
    """Write the figure `draw(*data)`, in the house style, in all formats; returns the pictures."""
    files = [folder / f"{name}.{kind}" for kind in _DPI]
    with house_style():
        figure = draw(*data)
        _lay_out(figure)
        # Neither before nor after a format would Matplotlib draw it all once more, to lay it out.
        with matplotlib.rc_context({"figure.constrained_layout.use": False}):
            figure.set_layout_engine(None)
            for file, kind in zip(files, _DPI, strict=True):
                picture = _picture(figure, kind)
                write_whole(file, lambda path, picture=picture: path.write_bytes(picture))
    return files


def _lay_out(figure: Figure) -> None:
    """Place what a figure holds as for the first format, at its resolution, for all of them."""
    engine = figure.get_layout_engine()
    if engine is not None:
        FigureCanvasAgg(figure)
        own, figure.dpi = figure.dpi, next(iter(_DPI.values()))
        engine.execute(figure)
        figure.dpi = own


def _picture(figure: Figure, kind: str) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=_DPI[kind], **_SAVED[kind])
    return stream.getvalue()
