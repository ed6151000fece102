"""The scenario suite, found by path, by name or by tag: shipped files, and those in ./scenarios.

One in ./scenarios takes the place of the shipped one of its name: who edits a copy runs the copy.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.scenario.yaml_files import OWN, SHIPPED, read_mapping
from mapfusion.errors import InputError, did_you_mean
from mapfusion.files import write_whole

if TYPE_CHECKING:
    from experiments.scenario.settings import Scenario

SUFFIXES = {".yaml", ".yml", ".json"}  # a JSON file is YAML too: a result's scenario.json


def scenarios_of(names_or_tags: Sequence[str | Path], folder: Path | None = None) -> list[Path]:
    """Scenario files, in the order asked for and each once.

    Each is asked for by its path, by the name of a scenario in `folder` (of the suite by default),
    or by a tag, which stands for all scenarios that carry it (in the order of their files' names).

    Raises:
        InputError: nothing of that name; lists the names and tags there are.
    """
    found: list[Path] = []
    for wanted in names_or_tags:
        path = Path(wanted)
        if path.suffix in SUFFIXES or len(path.parts) > 1 or path.is_file():
            found.append(path)
        else:
            found += _named(str(wanted), folder)
    return list(dict.fromkeys(found))


def one_scenario(word: str | Path, folder: Path | None = None) -> Path:
    """The file of a scenario asked for by path or name; raises InputError for a tag of several."""
    found = scenarios_of([word], folder)
    if len(found) != 1:
        names = ", ".join(path.stem for path in found)
        raise InputError(f"{word}: stands for {len(found)} scenarios ({names}); name one of them")
    return found[0]


def settings_of(
    word: str | Path | None, overrides: Sequence[str] = (), seed: int | None = None
) -> Scenario:
    """What a scenario sets, or the defaults without one; raises InputError."""
    # Settings import all that has some: not for a search by name or a listing.
    from experiments.scenario.loading import default_settings, load_scenario

    if word is None:
        return default_settings(overrides, seed)
    return load_scenario(one_scenario(word), overrides, seed)


def _named(wanted: str, folder: Path | None) -> list[Path]:
    files = _files(folder)
    if any(path.stem == wanted for path in files):
        # all of them take a third of a second to read; who else has the name has its letters
        files = [path for path in files if path.stem == wanted or _mentions(path, wanted)]
    known = {path: read_mapping(path) for path in files}
    by_name = [path for path, data in known.items() if wanted in (data.get("name"), path.stem)]
    by_tag = [path for path, data in known.items() if wanted in _tags(data)]
    if not by_name and not by_tag:
        tags = sorted({tag for data in known.values() for tag in _tags(data)})
        raise InputError(
            f"{wanted}: neither a file, nor a scenario of {folder or 'the suite'} "
            f"({', '.join(path.stem for path in known) or 'there is none'}), nor a tag "
            f"({', '.join(tags) or 'there is none'})"
            f"{did_you_mean(wanted, [*(path.stem for path in known), *tags])}"
        )
    return by_name or by_tag


def _mentions(path: Path, word: str) -> bool:
    try:
        return word.encode("utf-8", "surrogateescape") in path.read_bytes()
    except OSError:
        return True  # to be told by who reads it


def copy_to_edit(name: str) -> Path:
    """Copy a shipped scenario to ./scenarios and give the copy's path.

    Raises:
        InputError: there is none of that name, or a file is in the way.
    """
    shipped = {path.stem: path for path in _files(SHIPPED)}
    if name not in shipped:
        raise InputError(f"--copy {name}: no scenario of the suite; known: {', '.join(shipped)}")
    source = shipped[name]
    copy = OWN / source.name
    if copy.exists():
        raise InputError(f"{copy}: exists; edit it, or rename it to get the shipped one again")
    write_whole(copy, lambda temporary: temporary.write_bytes(source.read_bytes()))
    return copy


def _files(folder: Path | None) -> list[Path]:
    """Scenario files in the order of their names; of the suite where there is no folder."""
    if folder is None:
        by_name = {path.stem: path for each in (SHIPPED, OWN) for path in _files(each)}
        return [by_name[name] for name in sorted(by_name)]
    return sorted(path for path in folder.glob("*") if path.suffix in {".yaml", ".yml"})


def _tags(data: dict) -> list[str]:
    tags = data.get("tags")
    return [str(tag) for tag in tags] if isinstance(tags, list) else []


def entries(folder: Path | None = None) -> list[dict[str, Any]]:
    """Return what the files of a folder, or the suite's, say, in the order of their names.

    `iterations` are frames a robot, None for recorded logs; `overlap` is the overlap of the robots'
    ground that is asked for, None where the world is not generated. Settings are not checked here:
    a value of another type than expected is None.

    Raises:
        InputError: the folder holds no scenario, or a file is no mapping.
    """
    files = _files(folder)
    if not files:
        raise InputError(
            f"{folder}: holds no scenario (*.yaml); without a folder the suite is listed"
        )
    return [_entry(path) for path in files]


def _entry(path: Path) -> dict[str, Any]:
    from sim.plan_generator import RouteParameters

    data = read_mapping(path)
    generate, generated, drive = (
        _section(data, name) for name in ("generate", "generated", "drive")
    )
    robots, overlap = data.get("logs", data.get("robots")), generated.get("overlap_asked")
    n_robots = len(robots) if isinstance(robots, list) else None
    if "generate" in data:
        n_robots = generate.get("robots", RouteParameters.robots)
        overlap = generate.get("overlap", RouteParameters.overlap)
    return {
        "name": str(data.get("name", path.stem)),
        "tags": _tags(data),
        "description": str(data.get("description", "")),
        "recorded": "logs" in data,
        "robots": _number(n_robots),
        "iterations": _number(drive.get("frames")),
        "overlap": _number(overlap),
    }


def _section(data: dict[str, Any], name: str) -> dict[str, Any]:
    found = data.get(name)
    return found if isinstance(found, dict) else {}


def _number(value: Any) -> float | None:
    return value if isinstance(value, int | float) else None
