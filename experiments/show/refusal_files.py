"""What the study `refusal` leaves behind beside its answers: rates by kind of world, figures."""

from pathlib import Path
from typing import Any

import pandas as pd

from experiments.judge.tables import table_path
from experiments.run.frames import FLOAT, INT, TEXT, fields, write_rows
from experiments.show.export import to_markdown, write_text
from experiments.show.figures import refusal_figures, verdict_figures
from experiments.show.figures.drawing import save_figure
from experiments.study.refusal.kind_rates import VERDICTS, first_of_ordinary, of_any_method
from experiments.study.refusal.refusal_rates import Rate, ordinary
from experiments.study.refusal.reliability import Reliability
from mapfusion.storage import schema

_RATES = ("false_runs", "false_pairs", "false_by_chance", "wrong_pairs", "on_ground", "ambiguous")
_RATES += tuple(f"right_{verdict}" for verdict in VERDICTS)
_FIRST = ("first_iteration", "first_true_pairs")
# A row for each kind of world and method: NAME of NAME_of, with Wilson's interval (`kind_rates`).
KINDS = schema(
    "refusal.kinds",
    1,
    fields(
        **dict.fromkeys(("kind", "aligner"), TEXT),
        **{
            f"{name}{end}": kind
            for name in _RATES
            for end, kind in (("", INT), ("_of", INT), ("_low", FLOAT), ("_high", FLOAT))
        },
        **dict.fromkeys([*_FIRST, *(f"{name}_by_chance" for name in _FIRST)], FLOAT),
    ),
)


def write_kinds(folder: Path, refusals: pd.DataFrame, rows: list[dict[str, Any]]) -> Path:
    """Write rows of `kind_rates.by_kind` as the table `kinds` and, for people, `kinds.md`.

    The page begins with what any method does (`of_any_method`), and how early ordinary worlds are
    come upon (`first_of_ordinary`).
    """
    write_rows(table_path(folder, "kinds"), KINDS, [_flat(row) for row in rows])
    page, text = folder / "kinds.md", "# Verdicts by kind of world\n"
    parts = {"Any method": of_any_method(refusals)}
    if first := first_of_ordinary(refusals):
        parts["First right answers in worlds that do not repeat themselves"] = first
    parts["Each method"] = rows
    for title, part in parts.items():
        shown = [{name: _told(value) for name, value in row.items()} for row in part]
        text += f"\n## {title}\n\n{to_markdown(pd.DataFrame(shown))}\n"
    write_text(page, text)
    return page


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Rate):
            low, high = value.interval
            flat |= {name: value.hits, f"{name}_of": value.n}
            flat |= {f"{name}_low": low, f"{name}_high": high}
        else:
            flat[name] = value
    return flat


def _told(value: Any) -> Any:
    return f"{value.hits}/{value.n}" if isinstance(value, Rate) else value


def draw_refusals(
    folder: Path,
    refusals: pd.DataFrame,
    calibration: pd.DataFrame,
    false_alarms: float,
    held: Reliability | None,
) -> list[Path]:
    """Draw the figures that there is data for; returns their files."""
    place, files = folder / "figures", []
    if len(ordinary(refusals)):
        data = (refusals, calibration, false_alarms)
        files += save_figure(place, "refusal", refusal_figures.draw, *data)
    files += save_figure(place, "refusal_kinds", verdict_figures.draw_kinds, refusals)
    files += save_figure(place, "refusal_roc", verdict_figures.draw_roc, refusals)
    if held is not None:
        draw = verdict_figures.draw_reliability
        files += save_figure(place, "refusal_reliability", draw, held)
    return files
