"""Errors and warnings that a user reads."""

import difflib
import itertools
import re
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path

MOST_CHARACTERS = 500  # of a line: our longest messages fit, with two long paths in them
_MOST_OF_A_WORD = 120  # a path, as a rule
_GAP = "..."
_MOST_SUGGESTED = 3  # names; more are no help
# Share of letters in common, as `difflib` counts them, of names that are alike: two letters of
# three changed places (ipc, icp) give 2/3; words that only share some letters (nope, opencv) 0.6.
_LEAST_ALIKE = 0.65


class InputError(ValueError):
    """Something a user gave is unusable.

    Its text is one line that names the file, the field and what would be right.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class InputErrors(InputError):  # noqa: N818  # several of them
    """Several things a user gave are unusable; the text has one line for each of `lines`."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(one_line(line) for line in lines)
        super().__init__(*self.lines)

    def __str__(self) -> str:
        return "\n".join(self.lines)


class OutOfRangeError(InputError):
    """A setting that cannot have its value: its `name`, and the `problem`.

    `also` holds the name and problem of each further setting of the same class.
    """

    def __init__(self, name: str, problem: str, also: Iterable[tuple[str, str]] = ()) -> None:
        super().__init__(name, problem)
        self.name, self.problem, self.also = name, problem, tuple(also)

    def __str__(self) -> str:
        return one_line(f"{self.name}: {self.problem}")


class DamagedFileError(InputError):
    """A file is missing or not as it was written. `path`: which."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(path, reason)
        self.path = path

    def __str__(self) -> str:
        return f"{self.path}: {self.args[1]}"


class TellingWarning(UserWarning):
    """Something a user should know, in one line; the command shows it as it is."""


class MendedWarning(TellingWarning):
    """A damaged stage of the store is made again."""


class NameClashWarning(TellingWarning):
    """Two methods claim one name; the text says in one line which of them has it."""


def did_you_mean(wrong: str, known: Iterable[str]) -> str:
    """The end of a line about an unknown name: those of the known ones that look like it."""
    like = difflib.get_close_matches(wrong, list(known), _MOST_SUGGESTED, _LEAST_ALIKE)
    return f"; did you mean {' or '.join(like)}?" if like else ""


def one_line(text: str) -> str:
    """Return the text as one line of printable characters, without its middle if it is too long.

    Long words are shortened first, so that a quoted value does not displace what is said about it.
    What is left out of the line are whole words.
    """
    words = [_shortened(_printable(word)) for word in text.split()]
    line = " ".join(words)
    if len(line) <= MOST_CHARACTERS:
        return line
    last = _first_of(words[::-1], MOST_CHARACTERS // 3)[::-1]
    room = MOST_CHARACTERS - len(_GAP) - 2 - len(" ".join(last))
    return " ".join([*_first_of(words, room), _GAP, *last])


def _first_of(words: Sequence[str], most: int) -> list[str]:
    """Return the first of the words that take at most so many characters, with blanks between."""
    ends = itertools.accumulate(len(word) + 1 for word in words)
    return [word for word, end in zip(words, ends, strict=True) if end - 1 <= most]


def _printable(word: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in word)


def _shortened(word: str) -> str:
    """Return the first two thirds and the end of a word that is too long."""
    if len(word) <= _MOST_OF_A_WORD:
        return word
    first = 2 * _MOST_OF_A_WORD // 3
    return word[:first] + _GAP + word[len(word) - _MOST_OF_A_WORD + first + len(_GAP) :]


# New modules, and the former modules that plug-ins may import; all names without `mapfusion.`.
_FORMER_MODULES = {
    "geometry.se2": "se2 planar",
    "geometry.se3": "se3",
    "geometry.camera": "camera calibration_error",
    "geometry.joint_covariance": "joint_covariance",
    "geometry.numerics": "kernels one_thread chi_square symmetric align.bits",
    "parameters": "arguments",
    "files": "storage sealed",
    "tables": "open_tables looks",
    "robot_log": "log_part odometry_covariance stray",
    "attitude": "attitude_drift",
    "landmark_map": "joint_files",
    "viewing": "viewing_files",
    "registration": "align.registration align.supported align.completion",
    "align.alignment": "align.result align.pairs",
    "align.rigid_motion": "align.rigid",
    "align.method": "align.degeneracy",
    "align.correspondences": "align.nearest_descriptors",
    "align.mahalanobis_gate": "align.near_pairs align.leverage",
    "align.drift": "align.calibration_part",
    "align.consensus": "align.consistency",
    "align.clique": "align.max_clique",
    "align.nearest_neighbours": "align.box_tree align.nearest_points align.closest",
    "align.icp": "align.impicp",
    "align.refinement": "align.refine",
    "align.aligners": "align.registry",
    "verification": "evidence",
    "verification.false_alarms": "align.false_alarms align.named_landmarks align.acceptance",
    "verification.visibility": "evidence.watch evidence.expected",
    "verification.regions": "evidence.found evidence.regions evidence.parameters",
    "verification.rivals": "evidence.copies evidence.twins evidence.rivals",
    "verification.likelihood": "evidence.likelihood evidence.probability",
    "verification.verdict": "evidence.precision evidence.pair_evidence evidence.judge",
    "fusion": "fuse team",
    "fusion.aligned_landmarks": "aligned_landmarks same_point fuse.clusters",
    "fusion.fused_map": "fused_map name_order fuse.parameters fuse.component",
    "fusion.fusers": "fuse.fuser fuse.registry",
    "fusion.kalman": "fuse.sequential fuse.kalman fuse.kalman_drift",
    "fusion.covariance_intersection": "fuse.covariance_intersection",
    "fusion.joint": "fuse.jointly_fused fuse.joint",
    "fusion.joint_estimate": "fuse.joint_map fuse.joint_estimate",
    "fusion.batch": "fuse.batch",
    "fusion.pose_graph": "team.relations team.placement",
    "fusion.team_graph": "team.readings team.alternatives team.team_graph",
    "fusion.merge": "merge",
    "smoother.joint_smoothing": "smoother.recording smoother.together",
    "smoother.optimizer": "smoother.settle",
    "smoother.odometry_calibration": "smoother.odometry_error smoother.calibrate",
    "datasets": "recordings",
    "datasets.log_consistency": "log_consistency",
}
MOVED_MODULES = {
    f"mapfusion.{former}": f"mapfusion.{new}"
    for new, formers in _FORMER_MODULES.items()
    for former in formers.split()
}


def moved_module_note(error: BaseException) -> str:
    """Return the end of a line about a failed import that names the module to import instead.

    It is empty for other errors. Python reports a missing package without the module in the
    package; the full name is then read from the source line of the import.
    """
    if not isinstance(error, ImportError) or not error.name:
        return ""
    missing = error.name
    if attribute := re.match(r"cannot import name '(\w+)'", str(error)):
        missing = f"{missing}.{attribute[1]}"
    frames = reversed(traceback.extract_tb(error.__traceback__))
    imported = (re.findall(rf"{re.escape(missing)}(?:\.\w+)*", each.line or "") for each in frames)
    for name in (*itertools.chain.from_iterable(imported), missing):
        if name in MOVED_MODULES:
            return f"; {name} is now {MOVED_MODULES[name]}: change the import"
    return ""
