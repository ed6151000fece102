"""Outputs of commands: refused before anything is read where they could do harm.

An output is apart from the inputs: it is none of them, under whatever name, and no folder around
one. The ending of a file decides its format.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

from mapfusion.errors import InputError
from mapfusion.joint_files import joint_path
from mapfusion.landmark_map import MAP_ENDINGS
from mapfusion.open_tables import is_csv
from mapfusion.storage import require_writable
from mapfusion.viewing_files import viewing_paths

DOCUMENT, JUNIT, REPORT = (".json",), (".xml",), (".html", ".htm")
# Endings of files that commands write: a folder of such a name is a mistake.
_OF_FILES = {*MAP_ENDINGS, *DOCUMENT, *JUNIT, *REPORT, ".yaml", ".ply", ".g2o", ".tum", ".bag"}
_OF_RESULTS = {".ply", ".g2o", ".tum", ".rrd"}
# Tables of a robot log, as Parquet or CSV.
_OF_LOGS = {"frames", "observations", "truth_poses", "truth_points"}
_OF_LOGS |= {"odometry_covariance", "attitude"}
_COMPANIONS = (".joint", ".viewing", ".frames")  # ends of the stems of files beside a map
_RESULT = ("scenario.json", "world.json", "provenance.json", "tables", "keyframes")


def require_file(
    option: str, path: Path | None, endings: Sequence[str], inputs: Iterable[Path | str | None] = ()
) -> None:
    """Raise InputError unless a file can be written as one of these formats, apart from the inputs.

    Args:
        option: that names the file, for messages.
        path: of the file; None for none.
        endings: that it may have.
        inputs: files and folders that are read, and words that may be names of files.
    """
    if path is None:
        return
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder, which cannot be a file; name a file")
    if path.suffix.lower() not in endings:
        found = f"ends in {path.suffix}" if path.suffix else "has no ending"
        hint = "; `mapfusion export RESULT --format` writes others"
        export = hint if path.suffix.lower() in _OF_RESULTS else ""
        raise InputError(f"{option} {path}: {found}, expected {' or '.join(endings)}{export}")
    require_writable(path.parent)
    for each in _paths(inputs):
        if _is_same(path, each):
            raise InputError(f"{option} {path}: is an input ({each}); name another file")
        if not each.is_dir():
            continue
        in_log = path.resolve().parent == each.resolve() and path.resolve().stem in _OF_LOGS
        files = (file for file in each.iterdir() if file.stem in _OF_LOGS)
        if in_log or any(_is_same(path, file) for file in files):
            raise InputError(f"{option} {path}: is a file of the log {each}; name another file")


def require_map_file(path: Path, inputs: Sequence[Path | str | None], n_maps: int = 1) -> None:
    """Raise InputError unless so many maps, PATH, PATH.2 and so on, can be written.

    The files beside a Parquet map, of its joint covariance and viewing evidence, must not be those
    of an input either.
    """
    from experiments.judge.user_files import numbered

    require_file("--output", path, MAP_ENDINGS, inputs)
    companion = next((each for each in _COMPANIONS if path.stem.lower().endswith(each)), None)
    if companion and not is_csv(path):
        owner = f"{path.stem[: -len(companion)]}.parquet"
        reason = f"a file NAME{companion}.parquet belongs to the map NAME.parquet ({owner})"
        raise InputError(f"--output {path}: {reason}; choose another name")
    known = _paths(inputs)
    read = [*known, *(each for one in known for each in _beside(one) if each.is_file())]
    for k in range(1, n_maps + 1):
        of_map = numbered(path, k)
        for written in (of_map, *_beside(of_map)):
            for each in read:
                if _is_same(written, each):
                    raise InputError(
                        f"--output {path}: its file {written.name} would replace the input {each}; "
                        "name another file"
                    )


def require_folder(path: Path | None, inputs: Iterable[Path | str | None] = ()) -> None:
    """Raise InputError unless a folder can be written, apart from the inputs.

    It must be no input, and hold no folder that is one. Files in it that are inputs, as a scenario
    beside which results are put, stay.
    """
    if path is None:
        return
    if path.suffix.lower() in _OF_FILES and not path.is_dir():
        raise InputError(
            f"--output {path}: ends in {path.suffix}, as a file does; this command writes a folder"
        )
    if path.exists() and not path.is_dir():
        raise InputError(f"--output {path}: is a file; this command writes a folder")
    require_writable(path)
    for each in _paths(inputs):
        if _is_same(path, each):
            raise InputError(f"--output {path}: is an input; name another folder")
        if each.is_dir() and each.resolve().is_relative_to(path.resolve()):
            raise InputError(f"--output {path}: holds the input {each}; name another folder")


def require_result_folder(path: Path | None) -> None:
    """Raise InputError for a folder that holds something else than a result.

    A run removes outdated maps and images from its folder.
    """
    require_folder(path)
    if path is None or not path.is_dir():
        return
    if any(path.glob("[!.]*")) and not any((path / name).exists() for name in _RESULT):
        raise InputError(f"--output {path}: holds other files than a result's; name a new folder")


def _paths(inputs: Iterable[Path | str | None]) -> list[Path]:
    return [Path(each) for each in inputs if each is not None and Path(each).exists()]


def _is_same(path: Path, other: Path) -> bool:
    """Return True if two paths are the same file or folder, also through links."""
    if path.exists() and other.exists():
        return path.samefile(other)
    return path.resolve() == other.resolve()


def _beside(path: Path) -> tuple[Path, ...]:
    """Return the files that belong to a map's file."""
    return () if is_csv(path) else (joint_path(path), *viewing_paths(path))
