"""Which method to use, in a few sentences: the head of the report."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from experiments.judge.criteria import COMMON_LANDMARKS, RICH_PAIRS
from experiments.show.numbers import listed, metres, percent, radians, ratio
from experiments.study.statistics.standing import Recommendation, Standing

_RELIABLE = 0.5  # a method that surely fails more often than not is nothing to recommend
_SAME_AS_ORACLE = 1.1  # smaller ratios of two medians occur by chance


@dataclass(frozen=True)
class RecommendationText:
    """What the report says first.

    Attributes:
        headline: one short sentence; `name` follows it.
        name: the recommended method, or empty.
        lead: the sentence with the numbers.
        remarks: further sentences.
        sure: how strong the evidence is, short.
        sure_why: and why.
    """

    headline: str
    name: str
    lead: str
    remarks: tuple[str, ...]
    sure: str
    sure_why: str


def recommendation_text(
    ranking: Recommendation, n_robot_pairs: int, settings: Sequence[str] = ()
) -> RecommendationText:
    """Put a ranking into words.

    Args:
        ranking: of the aligners.
        n_robot_pairs: in the runs.
        settings: what a sweep varied between them.
    """
    evidence = _evidence(ranking, n_robot_pairs, settings)
    best = ranking.best
    if ranking.n_common == 0:
        lead = (
            f"None of the {ranking.n_maps} pairs of maps has {COMMON_LANDMARKS} or more landmarks "
            "in common. The only correct answer is to refuse."
        )
        merges = listed([f"{s.aligner} ({s.n_false})" for s in ranking.standings if s.n_false])
        remark = f"False merges: {merges}." if merges else "Every method refused, which is correct."
        return RecommendationText("No common ground.", "", lead, (remark,), *evidence)
    if best is None:
        lead = f"No method was correct on any of the {ranking.n_common} pairs with common ground."
        return RecommendationText("No method worked.", "", lead, (), *evidence)
    lead = (
        f"{best.aligner} aligned {percent(best.rate)} of {best.n_maps} pairs of maps with common "
        f"ground correctly (95 % interval {percent(best.low)} to {percent(best.high)}), with a "
        f"median error of {metres(best.refined_m)} and {radians(best.refined_rad)}. "
        f"{_beside_oracle(best, ranking)}"
    )
    remarks = (*_false_merges(best, ranking), *_equals(ranking), *_runner_up(ranking))
    headline = "Use" if best.high >= _RELIABLE else "No method is reliable; the best is"
    return RecommendationText(headline, best.aligner, lead, remarks, *evidence)


def _beside_oracle(best: Standing, ranking: Recommendation) -> str:
    if math.isnan(ranking.oracle_m):
        return "There is no oracle to compare it with."
    oracle = f"{metres(ranking.oracle_m)} and {radians(ranking.oracle_rad)}"
    text = f"The oracle, which is given the true pairs, reaches {oracle}"
    if math.isnan(best.over_oracle):
        return f"{text}."
    drift = ": the rest is the drift of the maps" if best.over_oracle < _SAME_AS_ORACLE else ""
    return (
        f"{text}; on maps with {RICH_PAIRS} or more true pairs the error is "
        f"{ratio(best.over_oracle)} times the oracle's{drift}."
    )


def _equals(ranking: Recommendation) -> tuple[str, ...]:
    if not ranking.equals or ranking.best is None:
        return ()
    verb = "performs" if len(ranking.equals) == 1 else "perform"
    faster = "" if math.isnan(ranking.best.time_ms) else f"; {ranking.best.aligner} is the fastest"
    return (f"On these maps {listed(ranking.equals)} {verb} equally well{faster}.",)


def _runner_up(ranking: Recommendation) -> tuple[str, ...]:
    rest = [s for s in ranking.standings[1:] if s.aligner not in ranking.equals and s.n_maps]
    if not rest:
        return ()
    text = f"Next is {rest[0].aligner}, correct in {percent(rest[0].rate)}"
    return (f"{text}, with a median error of {metres(rest[0].estimated_m)} as estimated.",)


def _false_merges(best: Standing, ranking: Recommendation) -> tuple[str, ...]:
    if not best.n_accepted:
        return (f"No result of {best.aligner} was accepted.",)
    if best.n_false == 0:
        text = f"None of its {best.n_accepted} accepted results is wrong"
    else:
        share = percent(best.n_false / best.n_accepted)
        text = (
            f"Of its {best.n_accepted} accepted results, {best.n_false} ({share}) are wrong: do "
            "not merge on acceptance alone"
        )
    poor = ranking.n_maps - ranking.n_common
    if poor:
        text += f"; {poor} of the {ranking.n_maps} pairs of maps have too little common ground"
    return (f"{text}.",)


def _evidence(
    ranking: Recommendation, n_robot_pairs: int, settings: Sequence[str]
) -> tuple[str, str]:
    """How strong the evidence is, and why."""
    if ranking.n_runs == 1:
        pairs = "one pair of robots" if n_robot_pairs == 1 else f"{n_robot_pairs} pairs of robots"
        return (
            "Indicative: one run",
            f"One world, one seed, {pairs}. Maps of neighbouring iterations share most of their "
            "landmarks, so the intervals are too narrow. A sweep over seeds shows how far the "
            "result generalises.",
        )
    why = (
        "Intervals count each run as one trial, since the maps of a run grow from one another; "
        "they hold for other seeds too."
    )
    if settings:
        why += (
            f" The runs also differ in {listed(settings)}; here they are pooled, and runs of one "
            "seed share their world."
        )
    return f"Measured over {ranking.n_runs} runs", why
