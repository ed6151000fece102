"""Figures of a result, drawn from its stored tables and key frames.

`figures/drawn.json` records a digest of the inputs and of the pictures of each figure. A run keeps
a figure whose digests have not changed. Matplotlib is imported only to draw.
"""

from __future__ import annotations

import hashlib
import io
import pkgutil
import time
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from experiments.evaluation.tables import table_path
from experiments.pipeline.stage import imported_sources, library_versions, source_hash
from experiments.pipeline.workers import Workers, workers
from mapfusion.files import read_json, write_atomically, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from experiments.reports.figures.result_tables import ResultTables


class _Figure(NamedTuple):
    """Entry of the registry of figures.

    Attributes:
        module: module of this package with the function.
        function: draws the figure from `ResultTables`.
        caption: first sentence of the caption; the label of the figure may add sentences that
            depend on the data.
        reads: names of the tables that the function reads, and `scenario` if it reads this.
    """

    module: str
    function: str
    caption: str
    reads: tuple[str, ...]


_ANSWERS = ("errors", "estimates")
_MERGE = ("fused", "fused_motions", "landmarks", "robots")
_REGISTRY = {
    "fig01_tracks": _Figure(
        "slam_figures",
        "draw_tracks",
        "Figure 1: Harris points, described by U-SURF, tracked over consecutive key frames.",
        ("robots", "tracks"),
    ),
    "fig02_two_maps": _Figure(
        "map_figures",
        "draw_two_maps",
        "Figure 2: the local maps of two robots before alignment, each in its own frame.",
        ("clouds", "map_history", "paths", "robots", "scenario", "sightings", "smoothed_paths"),
    ),
    "fig03_dispersion": _Figure(
        "slam_figures",
        "draw_dispersion",
        "Figure 3: dispersion of the particles along the paths.",
        ("clouds", "paths", "robots", "sightings"),
    ),
    "fig04_translation_error": _Figure(
        "error_figures",
        "draw_translation_error",
        "Figure 4: error of the alignments' translation against the iteration. Of lines that "
        "coincide, the narrow ones are drawn above the wide ones. A line ends where the method has "
        "no answer. The first two panels show the alignments of FastSLAM's maps, the third one "
        "those of smoothed maps.",
        (*_ANSWERS, "smoothed_errors"),
    ),
    "fig05_rotation_error": _Figure(
        "error_figures",
        "draw_rotation_error",
        "Figure 5: signed error of the alignments' rotation against the iteration, drawn as in "
        "figure 4.",
        (*_ANSWERS, "smoothed_errors"),
    ),
    "fig06_aligner_time": _Figure(
        "error_figures",
        "draw_aligner_time",
        "Figure 6: time of the aligners against the number of overlapping points. Points and bars "
        "of one pair of maps are set apart.",
        ("aligner_timings", *_ANSWERS),
    ),
    "fig07_correspondences": _Figure(
        "map_figures",
        "draw_correspondences",
        "Figure 7: two maps in their own frames, in space, and the correspondences between them.",
        ("correspondences", *_ANSWERS, "landmarks", "robots", "true_pairs"),
    ),
    "fig08_fused_landmark": _Figure(
        "map_figures",
        "draw_fused_landmark",
        "Figure 8: one landmark in the maps of two robots and in the fused map.",
        _MERGE,
    ),
    "fig09_aligned_maps": _Figure(
        "map_figures",
        "draw_aligned_maps",
        "Figure 9: corresponding landmarks of two aligned maps, and the fused landmarks.",
        _MERGE,
    ),
    "fig10_fused_map": _Figure(
        "map_figures",
        "draw_fused_map",
        "Figure 10: the fused map in plan.",
        ("fused", "fused_map", "fused_motions", "robots"),
    ),
    "fig11_fusers": _Figure(
        "error_figures",
        "draw_fusers",
        "Figure 11: error of the fused map against the iteration, for each fuser.",
        ("fusers",),
    ),
    "fig12_coverage": _Figure(
        "error_figures",
        "draw_coverage",
        "Figure 12: true points inside the error ellipses against the ellipses' probability.",
        ("fuser_coverage",),
    ),
    "fig13_team": _Figure(
        "error_figures",
        "draw_team",
        "Figure 13: robots that exchange maps while they drive, compared with independent robots.",
        ("adoptions", "team_members"),
    ),
}
FIGURES = tuple(_REGISTRY)
_RECORD, _TEXT = "drawn.json", ".txt"
# The resolution of an SVG is of the parts drawn as pixels, which make up most of the file.
_DPI = {"png": 200, "svg": 150}
# No date: the same tables give the same bytes. PNG files are compressed faster, and less.
_SAVED = {"png": {"pil_kwargs": {"compress_level": 2}}, "svg": {"metadata": {"Date": None}}}


class Drawn(NamedTuple):
    """Outcome of drawing figures.

    Attributes:
        files: pictures written.
        skipped: one line for each figure without data, with the reason.
        elapsed_s: time of each figure when it was last drawn, in seconds.
    """

    files: list[Path]
    skipped: list[str]
    elapsed_s: dict[str, float]


class _Record:
    """Digests of the inputs and of the pictures of the figures of one result.

    Create the record after the key frames and `world.json` are written: they are inputs of all
    figures.
    """

    def __init__(self, result: Path) -> None:
        self._result = result
        self._file = result / "figures" / _RECORD
        try:
            self._known = dict(read_json(self._file, "record of drawn figures")["figures"])
        except (OSError, KeyError, TypeError, ValueError):
            self._known = {}  # there is no readable record of the last drawing
        self._now: dict[str, dict[str, Any]] = {}  # new entries
        frames = sorted((result / "keyframes").glob("*.png"))
        self._common_inputs = _digest([result / "world.json", *frames])  # of all figures

    def unchanged(self, name: str) -> Drawn | None:
        """Return the last drawing of a figure if its inputs and pictures have not changed."""
        reads = _REGISTRY[name].reads
        tables = [table_path(self._result, each) for each in reads if each != "scenario"]
        scenario = [self._result / "scenario.json"] if "scenario" in reads else []
        inputs = _digest([*tables, *scenario]) + self._common_inputs
        self._now[name] = {"code": _code(name), "inputs": inputs}
        known, files = self._known.get(name), _files(self._result, name)
        if not isinstance(known, dict) or known.get("code") != _code(name):
            return None
        if known.get("inputs") != inputs or known.get("pictures") != _digest(files):
            return None
        skipped, elapsed_s = known.get("skipped"), known.get("elapsed_s")
        if not isinstance(skipped, str) or not isinstance(elapsed_s, float):
            return None
        shown = [file for file in files if file.suffix != _TEXT and file.is_file()]
        return Drawn(shown, [skipped] if skipped else [], {name: elapsed_s})

    def write(self, outcomes: Mapping[str, Drawn]) -> None:
        """Record the present state of the figures, in the order of their names."""
        figures = {
            name: self._now[name]
            | {
                "pictures": _digest(_files(self._result, name)),
                "skipped": "".join(drawn.skipped),
                "elapsed_s": drawn.elapsed_s[name],
            }
            for name, drawn in sorted(outcomes.items())
        }
        write_json(self._file, {"figures": figures})


def _digest(files: Iterable[Path]) -> str:
    """Return the SHA-256 digest of names and contents of files; missing files are included."""
    digest = hashlib.sha256()
    for file in files:
        content = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else "missing"
        digest.update(f"{file.name} {content}\n".encode())
    return digest.hexdigest()


def _code(name: str) -> str:
    """Return the digest of the source of a figure and of the versions of its libraries."""
    sources = source_hash(imported_sources(f"{__package__}.{_REGISTRY[name].module}", __name__))
    drawing = [version(each) for each in ("matplotlib", "pandas", "pillow")]
    known = "\n".join([sources, *library_versions().values(), *drawing])
    return hashlib.sha256(known.encode()).hexdigest()


def _files(result: Path, name: str) -> list[Path]:
    """Return the pictures of a figure and its caption."""
    suffixes = [*(f".{kind}" for kind in _DPI), _TEXT]
    return [result / "figures" / f"{name}{suffix}" for suffix in suffixes]


class Drawing:
    """Drawing of the figures of one result, each as soon as its inputs are written.

    Args:
        pool: workers that draw the figures.
        again: also draw figures whose inputs have not changed.
    """

    def __init__(self, pool: Workers, again: bool = False) -> None:
        self._pool, self._again = pool, again
        self._written: set[str] = set()
        self._begun: set[str] = set()
        self._kept: dict[str, Drawn] = {}
        self._record: _Record | None = None

    def written(self, result: Path, part: str) -> None:
        """Start the figures whose inputs are complete now that a table or `scenario` is written."""
        self._written.add(part)
        self._record = self._record or _Record(result)
        for name in FIGURES:
            if name not in self._begun and self._written.issuperset(_REGISTRY[name].reads):
                self._start_drawing(name, self._record, result)

    def _start_drawing(self, name: str, record: _Record, result: Path) -> None:
        self._begun.add(name)
        unchanged = record.unchanged(name)
        if unchanged and not self._again:
            self._kept[name] = unchanged
            return
        from experiments.reports.figures.result_tables import ResultTables

        data = ResultTables(result, written=_REGISTRY[name].reads)
        self._pool.submit(name, draw_figure, data, name)

    def finish(self, result: Path, on_progress: Callable[[int, int], None] | None = None) -> Drawn:
        """Draw the remaining figures, and return all in order.

        Args:
            result: folder of the result.
            on_progress: called after each figure with the numbers of figures done and in total.

        Raises:
            InputError: a table is missing or damaged.
        """
        self._record = self._record or _Record(result)
        for name in FIGURES:
            if name not in self._begun:
                self._start_drawing(name, self._record, result)
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

    Progress, result and errors are those of `Drawing.finish`.
    """
    with workers(jobs) as pool:
        return Drawing(pool, again=True).finish(result, on_progress)


def remove_figures(result: Path) -> None:
    """Remove the figures of an earlier run from a result folder."""
    for name in FIGURES:
        for picture in _files(result, name):
            picture.unlink(missing_ok=True)
    (result / "figures" / _RECORD).unlink(missing_ok=True)


def draw_figure(data: ResultTables, name: str, folder: Path | None = None) -> Drawn:
    """Draw one of `FIGURES` into a folder, by default `figures` in the folder of the result.

    Old pictures are removed if there is nothing to draw.
    """
    from experiments.reports.figures.result_tables import NothingToDraw

    folder, started_s = folder or data.folder / "figures", time.perf_counter()
    files, skipped = list[Path](), list[str]()
    try:
        entry = _REGISTRY[name]
        draw = pkgutil.resolve_name(f"{__package__}.{entry.module}:{entry.function}")
        files = save_figure(folder, name, draw, data, caption=entry.caption)
    except NothingToDraw as reason:
        for suffix in (*(f".{kind}" for kind in _DPI), _TEXT):
            (folder / f"{name}{suffix}").unlink(missing_ok=True)
        skipped = [f"{name}: {reason}"]
    return Drawn(files, skipped, {name: time.perf_counter() - started_s})


def caption(name: str, folder: Path) -> str:
    """Return the caption of one of `FIGURES`: the text beside its picture, if there is one."""
    file = folder / f"{name}{_TEXT}"
    own = file.read_text(encoding="utf-8", errors="replace").strip() if file.is_file() else ""
    return own or _REGISTRY[name].caption


def _rendered(figure: Figure, kind: str) -> bytes:
    """Return the bytes of a figure as "png" or "svg"; tests replace this slow step."""
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=_DPI[kind], **_SAVED[kind])
    return stream.getvalue()


def save_figure(
    folder: Path, name: str, draw: Callable[..., Figure], *data: Any, caption: str = ""
) -> list[Path]:
    """Write the figure `draw(*data)` in the common style and all formats.

    Args:
        folder: folder of the files.
        name: name of the files.
        draw: returns the figure. The label of the figure is appended to the caption.
        data: arguments of `draw`.
        caption: text that is written beside the pictures; none if empty.

    Returns:
        The pictures.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from experiments.reports.figures.style import house_style

    files = [folder / f"{name}.{kind}" for kind in _DPI]
    with house_style():
        figure = draw(*data)
        if caption:
            text = f"{caption} {figure.get_label()}".strip() + "\n"
            write_atomically(
                folder / f"{name}{_TEXT}", lambda path: path.write_bytes(text.encode())
            )
        # Lay out the figure once for all formats, at the resolution of the first one.
        engine = figure.get_layout_engine()
        if engine is not None:
            FigureCanvasAgg(figure)
            own, figure.dpi = figure.dpi, next(iter(_DPI.values()))
            engine.execute(figure)
            figure.dpi = own
        # Without a layout engine Matplotlib does not lay out the figure again for each format.
        with matplotlib.rc_context({"figure.constrained_layout.use": False}):
            figure.set_layout_engine(None)
            for file, kind in zip(files, _DPI, strict=True):
                picture = _rendered(figure, kind)
                write_atomically(file, lambda path, picture=picture: path.write_bytes(picture))
    return files
