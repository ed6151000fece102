"""JSON files of a result folder, and a check that the files of a result are unchanged."""

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from experiments.evaluation.tables import table_path
from experiments.pipeline.store import FileEntry, require_unchanged
from mapfusion.errors import DamagedFileError, InputError
from mapfusion.files import read_json, require_version

RESULT_SCHEMA_VERSION = 1


class _World(BaseModel):
    walls: list[list[tuple[float, float]]] = []
    robots: dict[str, tuple[float, float, float]] = {}


class _Provenance(BaseModel):
    stages: dict[str, Any] = {}
    tables: list[str] = []
    files: dict[str, FileEntry] = {}  # empty in results of earlier versions
    libraries: dict[str, str] = {}


def read_scenario(path: Path) -> dict[str, Any]:
    """Return `scenario.json` of a result; raises DamagedFileError."""
    from experiments.scenario.settings import Bound  # imports all methods

    class _ResolvedScenario(BaseModel):
        name: str
        seed: int
        description: str = ""
        expect: dict[str, Bound] = {}
        merge: dict[str, Any] = {}

    return _checked(path, "resolved scenario", _ResolvedScenario)


def read_world(path: Path) -> dict[str, Any]:
    """Return `world.json` of a result; raises DamagedFileError."""
    return _checked(path, "world of a result", _World)


def read_provenance(path: Path) -> dict[str, Any]:
    """Return `provenance.json` of a result; raises DamagedFileError."""
    return _checked(path, "provenance of a result", _Provenance)


def require_tables(result: Path) -> None:
    """Raise InputError if a table is missing that the run wrote into its result folder.

    Results of earlier versions do not list their tables.
    """
    path = result / "provenance.json"
    written = read_provenance(path).get("tables", ()) if path.is_file() else ()
    gone = [name for name in written if not table_path(result, name).is_file()]
    if gone:
        others = f" (and {len(gone) - 1} more)" if len(gone) > 1 else ""
        remedy = "put it back, or run the scenario again"
        missing = table_path(result, gone[0])
        raise InputError(f"{missing}: is missing{others}, but the run wrote it; {remedy}")


def require_as_written(result: Path) -> None:
    """Raise DamagedFileError if a table, map or JSON file was changed after the run."""
    path = result / "provenance.json"
    if path.is_file():
        require_unchanged(result, _Provenance.model_validate(read_provenance(path)).files)


def _checked(path: Path, what: str, model: type[BaseModel]) -> dict[str, Any]:
    found = read_json(path, what)
    require_version(path, found, RESULT_SCHEMA_VERSION)
    try:
        model.model_validate(found)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        raise DamagedFileError(path, f"{field}: {first['msg']} (expected a {what})") from error
    return found
