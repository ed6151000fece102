"""The verdict in plain words, and numbers as people read them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from experiments.judge.criteria import COMMON_LANDMARKS, RIGHT_WITHIN_M, RIGHT_WITHIN_RAD
from experiments.study.statistics.standing import Recommendation, Standing

_RELIABLE = 0.5  # a method that surely fails more often than not is nothing to recommend
_SPACE = "\u00a0"  # a number stays beside its unit


def correct_text() -> str:
    """What the numbers of the verdict mean."""
    return (
        f"Correct: within {RIGHT_WITHIN_M:g}{_SPACE}m and {RIGHT_WITHIN_RAD:g}{_SPACE}"
        f"rad of the truth once refined. Common ground: at least {COMMON_LANDMARKS} landmarks of "
        "both maps are one point of the world. Repetitions on the same maps are one trial of a "
        "Wilson interval, and so are, where there are several runs, all maps of a run."
    )


@dataclass(frozen=True)
class Words:
    """What the report says first.

    Attributes:
        headline: one short sentence; `name` stands in it for the method.
        name: the method to use, or empty.
        lead: the sentence with the numbers.
        remarks: further sentences.
        sure: how sure this is, short.
        sure_why: and why.
    """

    headline: str
    name: str
    lead: str
    remarks: tuple[str, ...]
    sure: str
    sure_why: str


def words_for(verdict: Recommendation, n_robot_pairs: int, settings: Sequence[str] = ()) -> Words:
    """Put a verdict into words.

    Args:
        verdict: of the aligners.
        n_robot_pairs: in the runs.
        settings: what a sweep varied between them.
    """
    sure, why = _surety(verdict, n_robot_pairs, settings)
    best = verdict.best
    if verdict.n_common == 0:
        lead = (
            f"In none of the {verdict.n_maps} pairs of maps are {COMMON_LANDMARKS} or more "
            "landmarks the same point of the world. The only right answer is to refuse."
        )
        return Words("No common ground.", "", lead, _refusals(verdict), sure, why)
    if best is None:
        lead = f"No method was correct on any of the {verdict.n_common} pairs with common ground."
        return Words("No method worked.", "", lead, (), sure, why)
    lead = (
        f"{best.aligner} put the two maps together correctly in {percent(best.rate)} of "
        f"{best.n_maps} pairs of maps with common ground "
        f"(95 % interval {percent(best.low)} to {percent(best.high)}), with a median error of "
        f"{metres(best.refined_m)} and {radians(best.refined_rad)}. "
        f"{_beside_oracle(best, verdict)}"
    )
    remarks = (*_false(best, verdict), *_equals(verdict), *_runner_up(verdict))
    reliable = best.high >= _RELIABLE
    headline = "Use" if reliable else "No method is reliable; the best is"
    return Words(headline, best.aligner, lead, remarks, sure, why)


def _beside_oracle(best: Standing, verdict: Recommendation) -> str:
    if math.isnan(best.over_oracle):
        return "There is no oracle to compare it with."
    return (
        f"The oracle, which is told the true pairs, comes to {metres(verdict.oracle_m)} and "
        f"{radians(verdict.oracle_rad)} on the same maps: what is left is the drift of the maps."
        if best.over_oracle < 1.1
        else f"The oracle, which is told the true pairs, comes to {metres(verdict.oracle_m)} and "
        f"{radians(verdict.oracle_rad)}: {best.over_oracle:.1f} times less."
    )


def _equals(verdict: Recommendation) -> tuple[str, ...]:
    if not verdict.equals or verdict.best is None:
        return ()
    several = listed(verdict.equals)
    verb = "does" if len(verdict.equals) == 1 else "do"
    faster = "" if math.isnan(verdict.best.time_ms) else f"; {verdict.best.aligner} is the fastest"
    return (f"On these maps {several} {verb} as well{faster}.",)


def _runner_up(verdict: Recommendation) -> tuple[str, ...]:
    rest = [s for s in verdict.standings[1:] if s.aligner not in verdict.equals and s.n_maps]
    if not rest:
        return ()
    text = f"Next comes {rest[0].aligner}, correct in {percent(rest[0].rate)}"
    return (f"{text}, {metres(rest[0].estimated_m)} off as estimated.",)


def _false(best: Standing, verdict: Recommendation) -> tuple[str, ...]:
    if not best.n_accepted:
        return (f"No result of {best.aligner} was accepted.",)
    share = best.n_false / best.n_accepted
    if best.n_false == 0:
        text = f"None of the {best.n_accepted} results that were accepted is wrong"
    else:
        text = (
            f"Of the {best.n_accepted} results that were accepted, {best.n_false} "
            f"({percent(share)}) are wrong: do not merge on acceptance alone"
        )
    poor = verdict.n_maps - verdict.n_common
    if poor:
        text += f"; {poor} of the {verdict.n_maps} pairs of maps have hardly any common ground"
    return (f"{text}.",)


def _refusals(verdict: Recommendation) -> tuple[str, ...]:
    merged = [s for s in verdict.standings if s.n_false]
    if not merged:
        return ("Every method refused, as it should.",)
    names = listed([f"{s.aligner} ({s.n_false})" for s in merged])
    return (f"Accepted all the same, wrongly: {names}.",)


def _surety(
    verdict: Recommendation, n_robot_pairs: int, settings: Sequence[str]
) -> tuple[str, str]:
    if verdict.n_runs == 1:
        pairs = "one pair of robots" if n_robot_pairs == 1 else f"{n_robot_pairs} pairs of robots"
        return (
            "Indicative: one run",
            f"One world, one seed, {pairs}. Maps of neighbouring iterations share most of their "
            "landmarks, so the intervals are narrower than the truth. A sweep over seeds tells how "
            "far this holds elsewhere.",
        )
    why = (
        "Intervals count each run as one trial, since the maps of a run grow from one another, so "
        "they hold for other seeds too."
    )
    if settings:
        why += (
            f" The runs also differ in {listed(list(settings))}; here they are taken together, and "
            "those of one seed share their worlds."
        )
    return f"Measured over {verdict.n_runs} runs", why


def listed(names: list[str] | tuple[str, ...]) -> str:
    """Names as a person lists them."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"


def percent(share: float) -> str:
    """A share as a percentage; 100 % and 0 % only where they are exact."""
    if math.isnan(share):
        return "–"
    value = 100 * share
    if 0 < value < 1:
        return f"<{_SPACE}1{_SPACE}%"
    if 99 < value < 100:
        return f">{_SPACE}99{_SPACE}%"
    return f"{value:.0f}{_SPACE}%"


def metres(value: float) -> str:
    """A length with about two digits that count."""
    return _with_unit(value, "m")


def radians(value: float) -> str:
    """An angle likewise."""
    return _with_unit(value, "rad")


def milliseconds(value: float) -> str:
    """A time likewise."""
    return _with_unit(value, "ms")


def bare(value: float) -> str:
    """A figure with about two digits that count; its unit stands in the heading."""
    if not math.isfinite(value):
        return "–"
    digits = 0 if value >= 100 else max(0, min(5, 1 - math.floor(math.log10(abs(value) or 1))))
    return f"{value:.{digits}f}"


def ratio(value: float) -> str:
    """How many times larger."""
    return "–" if not math.isfinite(value) else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def within(low: float | None, high: float | None) -> str:
    """A bound as people write it."""
    if low is None:
        return f"≤{_SPACE}{high:g}"
    return f"≥{_SPACE}{low:g}" if high is None else f"{low:g} to {high:g}"


def _with_unit(value: float, unit: str) -> str:
    return f"{bare(value)}{_SPACE}{unit}" if math.isfinite(value) else "–"
