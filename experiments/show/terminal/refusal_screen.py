"""What the command `study refusal` shows."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.judge.criteria import MERGEABLE_PAIRS, RIGHT_WITHIN_M, RIGHT_WITHIN_RAD
from experiments.show.numbers import interval
from experiments.show.terminal.layout import Column, columns, print_frame, print_table
from experiments.study.refusal.kind_rates import VERDICTS, pooled, worst
from experiments.study.refusal.refusal_rates import Rate
from experiments.study.refusal.reliability import Reliability

_RATES = columns(
    ">",
    false="false\nmerges",
    wrong="wrong\n",
    missed="missed\nof all",
    missed_though_right="of right",
    few_missed_though_right="20 true:\nmissed",
    few_wrong="wrong",
)


def print_refusals(rows: Sequence[dict[str, Any]], false_alarms: float) -> None:
    """False and missed merges of each aligner in ordinary worlds (rows of `refusal_rates`)."""
    if not rows:  # all worlds repeat themselves
        return
    _print_rates(
        rows,
        _RATES,
        f"Accepted where chance gives at most {false_alarms:g} a pair of maps",
        "false: accepted without common ground; wrong: accepted with some, "
        f"{RIGHT_WITHIN_M:g} m or {RIGHT_WITHIN_RAD:g} rad off; missed: refused with "
        f"{MERGEABLE_PAIRS} or more true pairs, of all and of those right; 20 true: just 20 in "
        "one corner are left",
    )
    wide = {
        name: f"{2 * float(name.removeprefix('poster_')):g} m\nwide"
        for name in rows[0]
        if name.startswith("poster_")
    }
    hung = {name: column for name, column in columns(">", **wide).items() if rows[0][name].n}
    if hung:
        what = "Accepted though wrong: one picture in two worlds"
        _print_rates(rows, hung, what, "wide: the picture hung in both")


def print_kinds(rows: Sequence[dict[str, Any]]) -> None:
    """What verdicts make of each kind of world (rows of `kind_rates.by_kind`)."""
    grouped = itertools.groupby(rows, key=lambda row: row["kind"])
    kinds = {kind: list(own) for kind, own in grouped}
    false = []
    for kind, own in kinds.items():
        (who, runs), (_, pairs) = (worst(own, name) for name in ("false_runs", "false_pairs"))
        false.append([kind, _hits(runs), _hits(pairs), who if runs.hits else ""])
    shown = columns(">", runs="runs", pairs="pairs of maps\nwithout common ground")
    print_table(
        [("kind of world", ""), *shown.values(), ("worst method\nof runs", "")],
        false,
        "Accepted though wrong, by kind of world",
        "of the method that is worst; runs: any of their maps",
    )
    found = [[kind, *_right(own)] for kind, own in kinds.items()]
    shown = columns(">", kept="accepted", ambiguous="ambi-\nguous", uncertain="too un-\ncertain")
    shown |= columns(">", refused="refused", first="first at\niteration", chance="by\nchance")
    print_table(
        [("kind of world", ""), *shown.values()],
        [row for row in found if row[1:] != ["–"] * (len(row) - 1)],
        "Right answers, by kind of world",
        f"of all methods, with {MERGEABLE_PAIRS} or more true pairs; first: a run's first right "
        f"answer that is accepted (median, {rows[0]['aligner']}), and by the test against chance "
        "alone",
    )


def _right(own: list[dict[str, Any]]) -> list[str]:
    """What becomes of the right answers of one kind, and when the first is accepted."""
    shares = [_hits(pooled(own, f"right_{verdict}")) for verdict in VERDICTS]
    first = [own[0][name] for name in ("first_iteration", "first_iteration_by_chance")]
    return [*shares, *("–" if math.isnan(value) else f"{value:.0f}" for value in first)]


def _hits(rate: Rate) -> str:
    return f"{rate.hits}/{rate.n}" if rate.n else "–"


def print_reliability(found: Reliability) -> None:
    """How the probability that verdicts state compares with what is right."""
    support, wrong = found.brier_of_support, f"{found.n_wrong} of {found.n} wrong"
    print_frame(
        found.bins,
        {"n": ("answers", "d"), "stated": ("stated", ".3f"), "right": ("right", ".3f")},
        f"Probability that an answer is right ({wrong})",
        f"calibration error {interval(*found.calibration_error, layout='.3f')}; Brier score "
        f"{interval(*found.brier, layout='.4f')}"
        + ("" if math.isnan(support) else f", of support alone {support:.4f}"),
    )


def _print_rates(
    rows: Sequence[dict[str, Any]], shown: Mapping[str, Column], title: str, note: str
) -> None:
    cells = [
        [row["aligner"], *(f"{row[name].hits}/{row[name].n}" for name in shown)] for row in rows
    ]
    print_table([("aligner", ""), *shown.values()], cells, title, note)
