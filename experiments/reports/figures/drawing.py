"""All figures of a result, each from stored tables and key frames alone.

`figures/drawn.json` records a digest of what each figure was drawn from, and of its pictures. A run
keeps a figure whose digests are still the same. Matplotlib is imported only to draw.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import re
import time
from collections.abc import Callable, Iterable, Mapping
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any, NamedTuple

from experiments.evaluation.tables import table_path
from experiments.pipeline.code_version import imported_sources, library_versions, source_hash
from experiments.pipeline.workers import Workers, workers
from mapfusion.files import read_json, write_json, write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from experiments.reports.figures.result_tables import ResultTables

# Each is a module `figNN_NAME` with a function `draw`; its docstring is the caption, and `READS`
# names what it takes of a result: tables, and `scenario`.
_MODULES = iter_modules([str(Path(__file__).parent)])
FIGURES = tuple(sorted(each.name for each in _MODULES if re.match(r"fig\d\d_", each.name)))
_RECORD = "drawn.json"
# An SVG's are of the parts that are drawn as pixels, which make up most of the file.
_DPI = {"png": 200, "svg": 150}
# No date: the same tables give the same bytes. PNG are packed faster than by default, and larger.
_SAVED = {"png": {"pil_kwargs": {"compress_level": 2}}, "svg": {"metadata": {"Date": None}}}


class Drawn(NamedTuple):
    """The pictures written, and one line each which figures there is no data for, and why.

    `elapsed_s` has the seconds that each figure took when it was drawn.
    """

    files: list[Path]
    skipped: list[str]
    elapsed_s: dict[str, float]


class _Record:
    """The digests of one result's figures: what each was drawn from, and its pictures.

    It is made once the key frames and `world.json` are written. All figures count as drawn from
    these.
    """

    def __init__(self, result: Path) -> None:
        self._result = result
        self._file = result / "figures" / _RECORD
        self._now: dict[str, dict[str, Any]] = {}  # entries of figures as they are to be drawn

    @cached_property
    def _known(self) -> dict[str, Any]:
        """The record of the last drawing; empty if there is none that can be read."""
        try:
            return dict(read_json(self._file, "record of drawn figures")["figures"])
        except (OSError, KeyError, TypeError, ValueError):
            return {}

    def _last(self, name: str) -> dict[str, Any]:
        """Return a figure's entry in that record, if it is of the same source and libraries."""
        known = self._known.get(name)
        return known if isinstance(known, dict) and known.get("code") == _code(name) else {}

    def reads(self, name: str) -> list[str]:
        """Return what a figure takes of a result; as its module says, if that has changed."""
        reads = self._last(name).get("reads")
        return reads if isinstance(reads, list) else list(_module(name).READS)

    @cached_property
    def _pictured(self) -> str:
        frames = sorted((self._result / "keyframes").glob("*.png"))
        return _digest([self._result / "world.json", *frames])

    def unchanged(self, name: str) -> Drawn | None:
        """Return the last drawing of a figure if its inputs and pictures are still the same."""
        reads = self.reads(name)
        tables = [table_path(self._result, each) for each in reads if each != "scenario"]
        described = [self._result / "scenario.json"] if "scenario" in reads else []
        inputs = _digest([*tables, *described]) + self._pictured
        self._now[name] = {"code": _code(name), "reads": reads, "inputs": inputs}
        known, pictures = self._last(name), _pictures(self._result, name)
        if known.get("inputs") != inputs or known.get("pictures") != _digest(pictures):
            return None
        skipped, elapsed_s = known.get("skipped"), known.get("elapsed_s")
        if not isinstance(skipped, str) or not isinstance(elapsed_s, float):
            return None
        shown = [file for file in pictures if file.is_file()]
        return Drawn(shown, [skipped] if skipped else [], {name: elapsed_s})

    def write(self, outcomes: Mapping[str, Drawn]) -> None:
        """Record the figures as they are now."""
        figures = {
            name: self._now[name]
            | {
                "pictures": _digest(_pictures(self._result, name)),
                "skipped": "".join(drawn.skipped),
                "elapsed_s": drawn.elapsed_s[name],
            }
            for name, drawn in outcomes.items()
        }
        write_json(self._file, {"figures": figures})


def _digest(files: Iterable[Path]) -> str:
    """Return the SHA-256 of files' names and contents; a file that is missing counts, too."""
    digest = hashlib.sha256()
    for file in files:
        content = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else "missing"
        digest.update(f"{file.name} {content}\n".encode())
    return digest.hexdigest()


def _code(name: str) -> str:
    """Return the digest of a figure's source and of the versions of the libraries behind it."""
    sources = source_hash(imported_sources(_module_name(name), __name__))
    return hashlib.sha256("\n".join([sources, *_versions()]).encode()).hexdigest()


@cache
def _versions() -> list[str]:
    drawing = [version(name) for name in ("matplotlib", "pandas", "pillow")]
    return [*library_versions().values(), *drawing]


def _pictures(result: Path, name: str) -> list[Path]:
    return [result / "figures" / f"{name}.{kind}" for kind in _DPI]


class Drawing:
    """The figures of one result, each drawn by a pool as soon as all that it reads is written.

    Args:
        pool: draws them.
        again: draw those too whose inputs have not changed since they were drawn.
    """

    def __init__(self, pool: Workers, again: bool = False) -> None:
        self._pool, self._again = pool, again
        self._written: set[str] = set()
        self._begun: set[str] = set()
        self._kept: dict[str, Drawn] = {}
        self._record: _Record | None = None

    def written(self, result: Path, part: str) -> None:
        """A part of a result is there: a table, or `scenario`."""
        self._written.add(part)
        self._record = self._record or _Record(result)
        for name in FIGURES:
            if name not in self._begun and self._written.issuperset(self._record.reads(name)):
                self._begin(name, self._record, result)

    def _begin(self, name: str, record: _Record, result: Path) -> None:
        self._begun.add(name)
        unchanged = record.unchanged(name)
        if unchanged and not self._again:
            self._kept[name] = unchanged
            return
        from experiments.reports.figures.result_tables import ResultTables

        data = ResultTables(result, written=record.reads(name))
        self._pool.submit(name, draw_figure, data, name)

    def finish(self, result: Path, on_progress: Callable[[int, int], None] | None = None) -> Drawn:
        """Draw those too of which nobody said that what they read is written.

        `on_progress` is told (figures done, figures in all) after each. Returns what was drawn in
        the order of the figures; raises InputError where a table is missing or damaged.
        """
        self._record = self._record or _Record(result)
        for name in FIGURES:
            if name not in self._begun:
                self._begin(name, self._record, result)
        outcomes = dict(self._kept)
        if outcomes and on_progress is not None:
            on_progress(len(outcomes), len(FIGURES))
        for name, outcome in self._pool.completed():
            outcomes[name] = outcome
            if on_progress is not None:
                on_progress(len(outcomes), len(FIGURES))
        self._record.write(outcomes)
        drawn = [outcomes[name] for name in FIGURES]
        files = [file for each in drawn for file in each.files]
        skipped = [line for each in drawn for line in each.skipped]
        elapsed_s = {name: s for each in drawn for name, s in each.elapsed_s.items()}
        return Drawn(files, skipped, elapsed_s)


def draw_all(
    result: Path, jobs: int = 2, on_progress: Callable[[int, int], None] | None = None
) -> Drawn:
    """Draw all figures of a result folder into `RESULT/figures/`, in `jobs` processes.

    Else as `Drawing.finish`.
    """
    with workers(jobs) as pool:
        return Drawing(pool, again=True).finish(result, on_progress)


def draw_figure(data: ResultTables, name: str, folder: Path | None = None) -> Drawn:
    """Draw one of `FIGURES` into a folder, by default `figures` in the result's.

    Old pictures of it are removed where there is nothing to draw.
    """
    from experiments.reports.figures.result_tables import NothingToDraw

    folder, started_s = folder or data.folder / "figures", time.perf_counter()
    files, skipped = list[Path](), list[str]()
    try:
        files = save_figure(folder, name, _module(name).draw, data)
    except NothingToDraw as reason:
        for kind in _DPI:
            (folder / f"{name}.{kind}").unlink(missing_ok=True)
        skipped = [f"{name}: {reason}"]
    return Drawn(files, skipped, {name: time.perf_counter() - started_s})


def _module(name: str) -> Any:
    return importlib.import_module(_module_name(name))


def _module_name(name: str) -> str:
    return f"experiments.reports.figures.{name}"


def save_figure(folder: Path, name: str, draw: Callable[..., Figure], *data: Any) -> list[Path]:
    """Write the figure `draw(*data)`, in the house style, in all formats; returns the pictures."""
    import matplotlib

    from experiments.reports.figures.style import house_style

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
    from matplotlib.backends.backend_agg import FigureCanvasAgg

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
