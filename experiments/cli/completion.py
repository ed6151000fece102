"""Completion of arguments in the shell: scenarios, formats, keys of settings and aligners.

Each function returns the known values that begin with what was typed. Where none does, the shell
completes names of files.
"""

from collections.abc import Iterable

import typer

# Formats of `experiments.reports.result_export`, whose import takes too long for a key press.
_EXPORTS = ("tum", "kitti", "g2o", "ply", "rerun")


def complete_scenario(incomplete: str) -> list[str]:
    """Complete the name of a scenario of the suite."""
    from experiments.scenario.suite import scenario_names

    return _beginning(scenario_names(), incomplete)


def complete_scenario_or_tag(incomplete: str) -> list[str]:
    """Complete the name of a scenario or a tag of the suite."""
    from experiments.scenario.suite import tags_as_written

    return complete_scenario(incomplete) + _beginning(tags_as_written(), incomplete)


def complete_format(context: typer.Context, incomplete: str) -> list[str]:
    """Complete a format of `record`, or of `export`."""
    if context.info_name == "record":
        from mapfusion.datasets.formats import EXPORTERS

        return _beginning(["log", *EXPORTERS], incomplete)
    return _beginning(_EXPORTS, incomplete)


def complete_setting(incomplete: str) -> list[str]:
    """Complete the dotted key of a setting, with the equals sign."""
    from experiments.scenario.loading import setting_keys

    return _beginning((f"{key}=" for key in setting_keys()), incomplete)


def complete_aligner(incomplete: str) -> list[str]:
    """Complete the name of an aligner."""
    from experiments.plugins.discovery import known_methods
    from experiments.scenario.settings import DEFAULT_ALIGNERS

    known = [*known_methods(), *(entry.name for entry in DEFAULT_ALIGNERS)]
    return _beginning(dict.fromkeys(known), incomplete)


def _beginning(known: Iterable[str], incomplete: str) -> list[str]:
    return [each for each in known if each.startswith(incomplete)]
