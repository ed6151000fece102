"""Errors and warnings with one-line messages for users."""

import difflib
import itertools
import re
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path

DISTRIBUTION = "mapfusion-bench"  # on the Python package index; the import package is `mapfusion`
MOST_CHARACTERS = 500  # of a message: enough for the longest one with two long paths
_MAX_WORD = 120  # characters of a word, usually a path
_GAP = "..."
_MAX_SUGGESTIONS = 3  # names in one message
# Smallest similarity ratio of `difflib` for a suggestion. Swapped letters in a word of three (ipc,
# icp) have the ratio 2/3; different words with some common letters (nope, opencv) have 0.6.
_MIN_SIMILARITY = 0.65


class InputError(ValueError):
    """Unusable input of a user.

    The message is one line that names the file, the field and the remedy.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class InputErrors(InputError):  # noqa: N818  # several errors
    """Several unusable inputs of a user; the message has one line for each of `lines`."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(one_line(line) for line in lines)
        super().__init__(*self.lines)

    def __str__(self) -> str:
        return "\n".join(self.lines)


class OutOfRangeError(InputError):
    """Setting with a value outside its range.

    Attributes:
        name: name of the setting.
        problem: description of the problem.
        also: name and problem of each further setting of the same class.
    """

    def __init__(self, name: str, problem: str, also: Iterable[tuple[str, str]] = ()) -> None:
        super().__init__(name, problem)
        self.name, self.problem, self.also = name, problem, tuple(also)

    def __str__(self) -> str:
        return one_line(f"{self.name}: {self.problem}")


class DamagedFileError(InputError):
    """File at `path` that is missing or damaged."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(path, reason)
        self.path = path

    def __str__(self) -> str:
        return f"{self.path}: {self.args[1]}"


class TellingWarning(UserWarning):
    """Warning with a one-line message for users; commands print the message unchanged."""


class StoreRepairWarning(TellingWarning):
    """Warning that a damaged stage of the store is computed again."""


class NameClashWarning(TellingWarning):
    """Warning that two methods have the same name; the message tells which one is used."""


def install_command(extra: str) -> str:
    """Return the command that installs an extra of our distribution."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def not_installed(package: str, extra: str) -> str:
    """Return a sentence that a package of an extra is missing, and how to install it."""
    return f"the package {package} is not installed; {install_command(extra)} installs it"


def did_you_mean(wrong: str, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: similar known names, or nothing."""
    like = difflib.get_close_matches(wrong, list(known), _MAX_SUGGESTIONS, _MIN_SIMILARITY)
    return f"; did you mean {' or '.join(like)}?" if like else ""


def one_line(text: str) -> str:
    """Return the text as one line of printable characters, and omit its middle if it is too long.

    Long words are shortened first, so that a long value does not displace the rest of the message.
    Then whole words are omitted.
    """
    escaped = "".join(
        c if c.isprintable() or c.isspace() else c.encode("unicode_escape").decode() for c in text
    )
    first = 2 * _MAX_WORD // 3  # of a word that is too long; its end stays, too
    words = [
        word
        if len(word) <= _MAX_WORD
        else word[:first] + _GAP + word[len(word) - _MAX_WORD + first + len(_GAP) :]
        for word in escaped.split()
    ]
    line = " ".join(words)
    if len(line) <= MOST_CHARACTERS:
        return line
    last = _first_of(words[::-1], MOST_CHARACTERS // 3)[::-1]
    room = MOST_CHARACTERS - len(_GAP) - 2 - len(" ".join(last))
    return " ".join([*_first_of(words, room), _GAP, *last])


def _first_of(words: Sequence[str], most: int) -> list[str]:
    """Return as many of the first words as fit into `most` characters, with blanks between."""
    ends = itertools.accumulate(len(word) + 1 for word in words)
    return [word for word, end in zip(words, ends, strict=True) if end - 1 <= most]


# New modules, and the former modules and functions that plug-ins may import; all names without
# `mapfusion.`.
_FORMER_MODULES = {
    "geometry.se2": "se2 planar",
    "geometry.se3": "se3",
    "camera": "calibration_error geometry.camera",
    "geometry.joint_covariance": "joint_covariance",
    "geometry.numerics": (
        "kernels one_thread chi_square symmetric align.bits parameters.require_finite "
        "parameters.require_shape parameters.require_points parameters.require_no_twins"
    ),
    "parameters": "arguments",
    "files": "storage sealed",
    "tables": "open_tables looks",
    "robot_log": "log_part odometry_covariance stray",
    "attitude": "attitude_drift",
    "landmark_map": "joint_files",
    "viewing": "viewing_files",
    "align.alignment": "align.result align.pairs align.method align.degeneracy",
    "align.rigid_motion": "align.rigid",
    "align.correspondences": "align.nearest_descriptors",
    "align.mahalanobis_gate": "align.near_pairs align.leverage",
    "align.covariance": "align.drift align.calibration_part",
    "align.consensus": "align.consistency",
    "align.clique": "align.max_clique",
    "align.nearest_neighbours": "align.box_tree align.nearest_points align.closest",
    "align.icp": "align.impicp",
    "align.refinement": "align.refine align.oracle",
    "align.ransac": "align.ransac_mahalanobis",
    "align.peers": "align.peers.opencv align.peers.kiss_matcher",
    "align.aligners": "align.registry",
    "verification": "evidence",
    "verification.false_alarms": "align.false_alarms align.named_landmarks align.acceptance",
    "verification.visibility": "evidence.watch evidence.expected",
    "verification.regions": "evidence.found evidence.regions evidence.parameters",
    "verification.rivals": "evidence.copies evidence.twins evidence.rivals",
    "verification.likelihood": "evidence.likelihood",
    "verification.registration": (
        "registration align.registration align.supported align.completion"
    ),
    "verification.verdict": "evidence.precision evidence.pair_evidence evidence.judge",
    "fusion": "fuse",
    "fastslam.landmark_arrays": "fastslam.landmarks",
    "fusion.landmark_association": (
        "fusion.aligned_landmarks aligned_landmarks same_point fuse.clusters"
    ),
    "fusion.fusers": (
        "fuse.fuser fuse.registry fuse.parameters fuse.component fusion.fused_map fused_map "
        "name_order"
    ),
    "fusion.kalman": "fuse.sequential fuse.kalman fuse.kalman_drift",
    "fusion.covariance_intersection": "fuse.covariance_intersection",
    "fusion.joint": "fuse.jointly_fused fuse.joint",
    "fusion.joint_estimate": "fuse.joint_map fuse.joint_estimate",
    "fusion.batch": ("fuse.batch smoother.joint_smoothing smoother.recording smoother.together"),
    "fusion.pose_graph": "team.relations team.placement",
    "fusion.team_graph": "team.readings team.alternatives team.team_graph",
    "fusion.merge": "merge",
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
