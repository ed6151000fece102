"""Runs and sweeps that are killed again and again, and each time started once more.

Each goes on where it was and ends with the files of one that nobody disturbed: it tells no
traceback, computes no finished stage twice and leaves no half-written file behind.
"""

import random
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tests.campaign.parts import Found
from tests.helpers.killing import Ended, KilledCommand, Victim
from tests.helpers.tiny_scenario import SHORT, TIMED

COMMANDS = {
    "run": ("--seed", "1"),
    "sweep": ("--seeds", "1", "--set", "slam.filter.n_particles=5,10"),
}
MOST_KILLS = 12  # of one run: then it may come to its end
_MOST_FILES, _LONGEST_MOMENT_S = 12, 0.5  # between two kills
_LONGEST_START_S = 6.0  # a kill in this time may come before there is any file
_SHARE_AT_START = 0.15
# How a command may end that was killed in a way; with 0 where it was just done.
_CODES = {
    "everything": {-9, 0},
    "terminated": {130, -15, 0},  # -15 before the command has begun
    "interrupted": {130, 0},
    "worker": {2, 0},
}
# What differs between any two runs: times, and when it was.
_DIFFER = {*TIMED, "run_times", "fig06_aligner_time", "drawn", "provenance"}
_ATTEMPTS = "attempts"  # the sweep's notes of deaths


class Kind(NamedTuple):
    """A command, and how many processes it uses."""

    command: str
    jobs: int

    @property
    def victims(self) -> tuple[Victim, ...]:
        """Who can be killed: a run in one process has no workers."""
        alone = self == ("run", 1)
        return ("everything", "interrupted", "terminated", *(() if alone else ("worker",)))


KINDS = [Kind(command, jobs) for jobs in (2, 1) for command in COMMANDS]


def explore(seed: str, kills: int, folder: Path) -> Found:
    """Kill so many times, in runs and sweeps in turn."""
    rng, counts, faults = random.Random(seed), Counter[str](), list[str]()
    scenario = folder / "short.yaml"
    scenario.write_text(SHORT, encoding="utf-8")
    for command in COMMANDS:
        with _started(Kind(command, 1), scenario, folder / command) as undisturbed:
            if (ended := undisturbed.finish())[0]:
                return Found(counts, [f"{command}, which nobody disturbed: {ended}"])
    for story in range(kills):
        if counts["kills"] >= kills:
            break
        kind = KINDS[story % len(KINDS)]
        results = folder / f"{story}-{kind.command}"
        left = min(kills - counts["kills"], MOST_KILLS)
        with _started(kind, scenario, results) as killed:
            told = Story(kind, killed, results)
            try:
                told.kill_and_go_on(rng, left)
                told.end(folder / kind.command)
            except AssertionError as error:
                told.faults.append(str(error))
        counts.update(told.kills, kills=len(told.kills))
        name = f"{kind.command} --jobs {kind.jobs}, number {story} of seed {seed}, {told.kills}"
        faults += [f"{name}: {fault}" for fault in told.faults]
        if not told.faults:
            shutil.rmtree(results)
    return Found(counts, faults)


def _started(kind: Kind, scenario: Path, results: Path) -> KilledCommand:
    arguments = (kind.command, scenario, *COMMANDS[kind.command])
    return KilledCommand(arguments, results, kind.jobs)


class Story:
    """One command from its first start to its end, how it was killed, and what was wrong."""

    def __init__(self, kind: Kind, killed: KilledCommand, results: Path) -> None:
        self._kind, self._killed, self._results = kind, killed, results
        self._finished: dict[Path, int] = {}
        self.kills, self.faults = list[str](), list[str]()

    def kill_and_go_on(self, rng: random.Random, most: int) -> None:
        """Kill at random until the command has come to its end or was killed so often."""
        while len(self.kills) < most:
            victim = rng.choice(self._kind.victims)
            if victim != "interrupted" and rng.random() < _SHARE_AT_START:
                alive = self._killed.makes(0, rng.uniform(0, _LONGEST_START_S))
            else:
                more = rng.randint(1, _MOST_FILES)
                alive = self._killed.makes(more, rng.uniform(0, _LONGEST_MOMENT_S))
            if not alive:
                break
            self._killed.kill(victim, rng)
            self.kills.append(victim)
            if victim != "worker" or self._kind.command == "run":
                self._look_at(self._killed.ended(), _CODES[victim])
                self._killed.go_on()
            self._nothing_is_lost()

    def end(self, undisturbed: Path) -> None:
        """Let the command come to its end, and hold what it made to what nobody disturbed."""
        self._killed.let_go()
        self._look_at(self._killed.ended(), {0})
        self._nothing_is_lost()
        abandoned = [str(path) for path in self._results.rglob(".*")]
        self.faults += [f"left behind: {', '.join(abandoned)}"] if abandoned else []
        mine, others = dict(_files(self._results)), dict(_files(undisturbed))
        differ = [str(name) for name in mine if mine[name] != others.get(name)]
        differ += [str(name) for name in others.keys() - mine.keys()]
        if differ:
            self.faults.append(f"not as one that nobody disturbed: {', '.join(differ)}")

    def _look_at(self, ended: Ended, codes: set[int]) -> None:
        said = ended.out + ended.err
        if "Traceback" in said:
            self.faults.append(f"ended with {ended.code} and told a traceback: {said[-2000:]!r}")
        elif ended.code not in codes:
            self.faults.append(f"ended with {ended.code}, expected {codes}: {said[-2000:]!r}")

    def _nothing_is_lost(self) -> None:
        """Check that finished parts stay and are not written again."""
        now = {path: path.stat().st_mtime_ns for path in _finished(self._results)}
        for path, before in self._finished.items():
            if now.get(path) != before:
                self.faults.append(f"{path}: {'made again' if path in now else 'lost'}")
        self._finished = now


def _finished(results: Path) -> Iterator[Path]:
    """Return the files that mark a stage's part as finished."""
    yield from results.glob("store/*/*/done*.json")


def _files(results: Path) -> Iterator[tuple[Path, bytes]]:
    """Return the files that must be equal in every run: paths in the folder, and bytes."""
    for path in sorted(results.rglob("*")):
        name = path.relative_to(results)
        timed = _DIFFER & {path.stem, path.parent.name}
        if path.is_file() and not timed and not path.stem.startswith("done"):
            yield name, path.read_bytes()
