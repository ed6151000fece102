"""All figures of a result, each from stored tables and key frames alone."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from experiments.run.workers import workers
from experiments.show.figures.result_tables import NothingToDraw, ResultTables
from experiments.show.figures.style import PNG_DPI, SVG_DPI, house_style
from mapfusion.storage import write_whole

FIGURES = (
    "fig01_tracks",
    "fig02_two_maps",
    "fig03_dispersion",
    "fig04_translation_error",
    "fig05_rotation_error",
    "fig06_aligner_time",
    "fig07_correspondences",
    "fig08_fused_landmark",
    "fig09_aligned_maps",
    "fig10_fused_map",
)
_DPI = {"png": PNG_DPI, "svg": SVG_DPI}


@dataclass(frozen=True)
class Drawn:
    """What became of one figure.

    Attributes:
        name: the figure.
        files: the pictures written; none when it was skipped.
        skipped: why it was skipped, in one line; empty when it was drawn.
    """

    name: str
    files: tuple[Path, ...]
    skipped: str = ""


def draw_all(
    result: Path,
    jobs: int = 2,
    on_progress: Callable[[int, int], None] | None = None,
    on_skip: Callable[[str], None] | None = None,
) -> list[Path]:
    """Draw figures 1 to 10 of a result folder into `RESULT/figures/`.

    A figure whose data the result does not hold is skipped; `on_skip` is told why.

    Args:
        result: a folder written by `run`.
        jobs: worker processes.
        on_progress: told (figures done, figures in all) after each one.
        on_skip: given one line for each figure that was skipped.

    Returns:
        The pictures written, in the figures' order.

    Raises:
        InputError: a table is missing or damaged.
    """
    outcomes: dict[str, Drawn] = {}
    with workers(jobs) as pool:
        for name in FIGURES:
            pool.submit(name, _draw_in_worker, result, name)
        for name, outcome in pool.completed():
            outcomes[name] = outcome
            if on_progress is not None:
                on_progress(len(outcomes), len(FIGURES))
    drawn = [outcomes[name] for name in FIGURES]
    for each in drawn:
        if on_skip is not None and each.skipped:
            on_skip(f"{each.name}: {each.skipped}")
    return [file for each in drawn for file in each.files]


def _draw_in_worker(result: Path, name: str) -> Drawn:
    return draw_figure(ResultTables(result), name)


def draw_figure(data: ResultTables, name: str, folder: Path | None = None) -> Drawn:
    """Draw one figure and write its pictures, or remove old ones when there is nothing to draw.

    Args:
        data: what it is drawn from.
        name: one of `FIGURES`.
        folder: for the pictures; `figures` in the result's by default.
    """
    module = importlib.import_module(f"experiments.show.figures.{name}")
    folder = folder or data.folder / "figures"
    with house_style():
        try:
            figure: Figure = module.draw(data)
        except NothingToDraw as reason:
            for file in _pictures(folder, name):
                file.unlink(missing_ok=True)
            return Drawn(name, (), str(reason))
        return Drawn(name, tuple(save_figure(figure, folder, name)))


def _pictures(folder: Path, name: str) -> list[Path]:
    return [folder / f"{name}.{suffix}" for suffix in _DPI]


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure in all formats (inside `house_style`); returns the pictures."""
    files = _pictures(folder, name)
    for file in files:
        write_whole(file, lambda path, kind=file.suffix[1:]: _save(figure, path, kind))
        figure.set_layout_engine("none")  # as laid out for the first; once is enough
    return files


def _save(figure: Figure, path: Path, kind: str) -> None:
    # No date: the same tables give the same bytes.
    metadata = {"Date": None} if kind == "svg" else None
    figure.savefig(path, format=kind, dpi=_DPI[kind], metadata=metadata)
