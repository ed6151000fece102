"""Options, exit codes and output checks that several commands share.

An output must not be an input, under any name or link, and no folder that contains an input. The
suffix of a file decides its format.
"""

import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from mapfusion.errors import InputError

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
EXIT_DEFECT = 70  # EX_SOFTWARE of sysexits.h: an error of ours
RESULTS = Path("results")
# Panels of the help, in the order of use.
RUN, LOOK, STEPS = "Run", "Look and compare", "Your own maps, logs and recordings"
# CPU cores that this process may use.
ALL_CORES = (
    len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
)

# Completion of arguments in the shell. Each function returns the known values that begin with what
# was typed. Where none does, the shell completes names of files.

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


# Options with a mutable default have it here, not in the signature of a command.
ScenarioNames = Annotated[
    list[str],
    typer.Argument(
        metavar="SCENARIO...",
        help="Scenario files, or names or tags of the suite.",
        autocompletion=complete_scenario_or_tag,
    ),
]
OneScenario = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="Scenario file, or a name of the suite.",
        autocompletion=complete_scenario,
    ),
]
SettingsOf = Annotated[
    str | None,
    typer.Option(
        "--scenario",
        metavar="SCENARIO",
        help="File or name whose settings to use.",
        autocompletion=complete_scenario,
    ),
]
ResultFolder = Annotated[Path, typer.Argument(metavar="RESULT", help="A run's result folder.")]
Overrides = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        default_factory=list,
        show_default=False,
        help="Replaces a value of the scenario, e.g. slam.filter.n_particles=50.",
        autocompletion=complete_setting,
    ),
]
Aligners = Annotated[
    list[str],
    typer.Option(
        "--aligner",
        metavar="NAME",
        default_factory=list,
        show_default=False,
        help="Only this aligner: a name, or a class of yours as FILE.py:CLASS; may be repeated.",
        autocompletion=complete_aligner,
    ),
]
ImportOverrides = Annotated[
    list[str],
    typer.Option(
        "--param",
        metavar="KEY=VALUE",
        default_factory=list,
        show_default=False,
        help="Replaces a setting of the importer, e.g. its noise: range_sigma_m=0.2.",
    ),
]
Format = Annotated[
    str,
    typer.Option(
        "--format",
        metavar="FORMAT",
        help="tum, kitti (paths), g2o (graph), ply (maps), rerun of results; "
        "log, euroc, kitti, tum_rgbd, rosbag, rosbag2 of runs.",
        autocompletion=complete_format,
    ),
]
Seed = Annotated[int | None, typer.Option(help="Replaces the scenario's seed (0).", min=0)]
Seeds = Annotated[str, typer.Option(help="A seed, a range 0..4 or a list 0,2,5.")]
Jobs = Annotated[int, typer.Option(help="Processes.", min=1, show_default="all cores")]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Check the input and print the plan; run nothing.")
]
Fresh = Annotated[bool, typer.Option("--fresh", help="Compute again what is stored already.")]
Results = Annotated[Path, typer.Option(help="Folder that results go to.", show_default="results")]
Output = Annotated[Path, typer.Option("--output", "-o", help="File or folder to write.")]
MapFile = Annotated[
    Path,
    typer.Option("--output", "-o", help="Map to write: .parquet (keeps all), .csv, .ply or .g2o."),
]
OutputFolder = Annotated[Path | None, typer.Option("--output", "-o", help="Folder to write.")]
SigmaM = Annotated[
    float | None,
    typer.Option(
        "--sigma",
        metavar="METRES",
        min=1e-6,
        max=1e3,
        help="Standard deviation per axis of the landmarks of maps without covariances.",
    ),
]
DescriptorMetric = Annotated[
    str,
    typer.Option(
        "--descriptor-metric",
        metavar="METRIC",
        help="Metric of descriptors that state none: euclidean, cosine or hamming (packed bits).",
    ),
]
DocumentFile = Annotated[
    Path | None, typer.Option("--output", "-o", help="File for what --json prints.")
]
ReportFile = Annotated[
    Path | None,
    typer.Option("--report", help="HTML file with the maps, correspondences and other motions."),
]
PlotFile = Annotated[
    Path | None,
    typer.Option("--plot", help="Picture of the same: .png, .svg or .pdf."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document instead.")]


def print_to_stderr(text: str) -> None:
    """Print a message in one line, also if it quotes text with line breaks."""
    from experiments.reports.layout import plain

    # `sys.stderr` replaces characters that the terminal lacks; `err=True` may open another stream
    typer.echo(f"mapfusion: {plain(' '.join(text.split()))}", file=sys.stderr)


def announce_compilation(as_json: bool = False) -> None:
    """Print a line on stderr before kernels are compiled in this process, unless `as_json`.

    A kernel is compiled by the first command that needs it after an installation or an update.
    """
    from mapfusion.geometry.numerics import before_compilation

    told = "compiling numerical kernels that no earlier command needed; later ones reuse them"
    before_compilation(None if as_json else lambda: typer.echo(told, file=sys.stderr))


DOCUMENT, JUNIT, REPORT = (".json",), (".xml",), (".html", ".htm")
PICTURE = (".png", ".svg", ".pdf")
# Suffixes of files that commands write; a folder with such a name is a mistake.
_OF_FILES = {*DOCUMENT, *JUNIT, *REPORT, *PICTURE, ".yaml", ".ply", ".g2o", ".tum", ".bag"}
_OF_RESULTS = {".ply", ".g2o", ".tum", ".rrd"}
# Tables of a robot log, as Parquet or CSV.
_OF_LOGS = {"frames", "observations", "truth_poses", "truth_points"}
_OF_LOGS |= {"odometry_covariance", "attitude"}
_COMPANIONS = (".joint", ".viewing", ".frames")  # ends of the stems of files that belong to a map
_RESULT = ("scenario.json", "world.json", "provenance.json", "tables", "keyframes")


def require_file(
    option: str, path: Path | None, endings: Sequence[str], inputs: Iterable[Path | str | None] = ()
) -> None:
    """Raise InputError unless a file can be written and is no input.

    Args:
        option: name of the command's option, for messages.
        path: the file; None passes.
        endings: allowed suffixes.
        inputs: files and folders that are read; words that are no paths are ignored.
    """
    if path is None:
        return
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder, which cannot be a file; name a file")
    if path.suffix.lower() not in endings:
        found = f"ends in {path.suffix}" if path.suffix else "has no ending"
        hint = "; `mapfusion export RESULT --format` writes others"
        export = hint if path.suffix.lower() in _OF_RESULTS else ""
        raise InputError(f"{option} {path}: {found}, expected {' or '.join(endings)}{export}")
    from mapfusion.files import require_writable

    require_writable(path.parent)
    for each in _paths(inputs):
        if _is_same(path, each):
            raise InputError(f"{option} {path}: is an input ({each}); name another file")
        if not each.is_dir():
            continue
        in_log = path.resolve().parent == each.resolve() and path.resolve().stem in _OF_LOGS
        files = (file for file in each.iterdir() if file.stem in _OF_LOGS)
        if in_log or any(_is_same(path, file) for file in files):
            raise InputError(f"{option} {path}: is a file of the log {each}; name another file")


def require_map_file(path: Path, inputs: Sequence[Path | str | None], n_maps: int = 1) -> None:
    """Raise InputError unless `n_maps` maps, PATH, PATH.2 and so on, can be written.

    The files of joint covariance and viewing evidence that belong to a Parquet map must not be
    files of an input either.
    """
    from mapfusion.fusion.map_merging import numbered_path
    from mapfusion.landmark_map import MAP_ENDINGS
    from mapfusion.tables import is_alone

    require_file("--output", path, MAP_ENDINGS, inputs)
    companion = next((each for each in _COMPANIONS if path.stem.lower().endswith(each)), None)
    if companion and not is_alone(path):
        owner = f"{path.stem[: -len(companion)]}.parquet"
        reason = f"a file NAME{companion}.parquet belongs to the map NAME.parquet ({owner})"
        raise InputError(f"--output {path}: {reason}; choose another name")
    known = _paths(inputs)
    read = [*known, *(each for one in known for each in _beside(one) if each.is_file())]
    for k in range(1, n_maps + 1):
        of_map = numbered_path(path, k)
        for written in (of_map, *_beside(of_map)):
            for each in read:
                if _is_same(written, each):
                    raise InputError(
                        f"--output {path}: its file {written.name} would replace the input {each}; "
                        "name another file"
                    )


def require_pictures(
    report: Path | None, plot: Path | None, inputs: Sequence[Path | str | None]
) -> None:
    """Raise InputError unless a page and a picture can be written and are no input."""
    require_file("--report", report, REPORT, inputs)
    require_file("--plot", plot, PICTURE, inputs)


def require_folder(
    path: Path | None, inputs: Iterable[Path | str | None] = (), may_hold: bool = False
) -> None:
    """Raise InputError unless a folder can be written, is no input and contains no input folder.

    It may contain input files, such as the scenario whose results are written; and input folders if
    `may_hold`, for a command that itself refuses to write into them.
    """
    from mapfusion.files import require_writable
    from mapfusion.landmark_map import MAP_ENDINGS

    if path is None:
        return
    if path.suffix.lower() in {*MAP_ENDINGS, *_OF_FILES} and not path.is_dir():
        raise InputError(
            f"--output {path}: ends in {path.suffix}, as a file does; this command writes a folder"
        )
    if path.exists() and not path.is_dir():
        raise InputError(f"--output {path}: is a file; this command writes a folder")
    require_writable(path)
    for each in _paths(inputs):
        if _is_same(path, each):
            raise InputError(f"--output {path}: is an input; name another folder")
        held = each.is_dir() and each.resolve().is_relative_to(path.resolve())
        if held and not may_hold:
            raise InputError(f"--output {path}: holds the input {each}; name another folder")


def require_result_folder(path: Path | None) -> None:
    """Raise InputError for a folder with other files than a result.

    A run removes outdated maps and images from its folder, so other files would be at risk.
    """
    require_folder(path)
    if path is None or not path.is_dir():
        return
    if any(path.glob("[!.]*")) and not any((path / name).exists() for name in _RESULT):
        raise InputError(f"--output {path}: holds other files than a result's; name a new folder")


def _paths(inputs: Iterable[Path | str | None]) -> list[Path]:
    return [Path(each) for each in inputs if each is not None and Path(each).exists()]


def _is_same(path: Path, other: Path) -> bool:
    """Return True if two paths are the same file or folder, also through links."""
    if path.exists() and other.exists():
        return path.samefile(other)
    return path.resolve() == other.resolve()


def _beside(path: Path) -> tuple[Path, ...]:
    """Return the files that belong to a map's file."""
    from mapfusion.landmark_map import joint_path
    from mapfusion.tables import is_alone
    from mapfusion.viewing import viewing_paths

    return () if is_alone(path) else (joint_path(path), *viewing_paths(path))
