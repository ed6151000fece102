"""Arguments of the commands that fit numbers of the verdict: worlds, seeds, folder."""

import argparse
from pathlib import Path

from experiments.scenario.seeds import parse_seeds
from experiments.studies.refusal_cases import MappedWorld, worlds_of


def worlds_asked_for(description: str | None) -> tuple[list[MappedWorld], dict[str, str]]:
    """Return the worlds of this process's arguments, and their name in a written file."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("worlds", nargs="+")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--results", type=Path, default=Path("results"))
    given = parser.parse_args()
    worlds = worlds_of(given.worlds, parse_seeds(given.seeds), given.results)
    return worlds, {"seeds": given.seeds.replace("..", " to "), "worlds": ", ".join(given.worlds)}
