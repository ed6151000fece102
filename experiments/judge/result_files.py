"""The JSON files of a result folder, each held to what its readers take from it."""

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from experiments.scenario.settings import Bound
from mapfusion.errors import DamagedFileError
from mapfusion.storage import read_json


class _ResolvedScenario(BaseModel):
    name: str
    seed: int
    description: str = ""
    expect: dict[str, Bound] = {}
    merge: dict[str, Any] = {}


class _World(BaseModel):
    walls: list[list[tuple[float, float]]] = []
    robots: dict[str, tuple[float, float, float]] = {}


class _Provenance(BaseModel):
    stages: dict[str, Any] = {}
    libraries: dict[str, str] = {}


def read_scenario(path: Path) -> dict[str, Any]:
    """A result's `scenario.json`; raises DamagedFileError."""
    return _checked(path, "resolved scenario", _ResolvedScenario)


def read_world(path: Path) -> dict[str, Any]:
    """A result's `world.json`; raises DamagedFileError."""
    return _checked(path, "world of a result", _World)


def read_provenance(path: Path) -> dict[str, Any]:
    """A result's `provenance.json`; raises DamagedFileError."""
    return _checked(path, "provenance of a result", _Provenance)


def _checked(path: Path, what: str, model: type[BaseModel]) -> dict[str, Any]:
    found = read_json(path, what)
    try:
        model.model_validate(found)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        raise DamagedFileError(path, f"{field}: {first['msg']} (expected a {what})") from error
    return found
