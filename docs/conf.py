"""Configuration of the documentation site, which `make docs` builds with Sphinx.

The pages of the reference are written from the code before each build.
"""

import ast
import inspect
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import typer
from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))

import mapfusion  # noqa: E402
from experiments.cli.main import app as command_line  # noqa: E402
from experiments.evaluation.metrics import ALIGNER_METRICS, METRICS  # noqa: E402
from experiments.evaluation.tables import MEANING  # noqa: E402
from experiments.pipeline.stage import use_kernel_cache  # noqa: E402
from experiments.scenario import settings  # noqa: E402
from experiments.scenario.loading import schema_text  # noqa: E402

use_kernel_cache()  # for the examples: kernels in the source tree may be of an earlier version

project = "mapfusion"
author = "the mapfusion authors"
release = mapfusion.__version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "examples", "pictures"]
html_theme = "furo"
html_math_renderer = "mathml"  # needs no script and no network
html_title = "mapfusion"
html_show_copyright = False
html_show_sphinx = False
default_role = "code"  # single backquotes in docstrings
autodoc_typehints = "none"  # the docstrings name types and shapes
autodoc_member_order = "bysource"
napoleon_use_ivar = True
REFERENCE = DOCS / "reference"


class Key(NamedTuple):
    """Key of a scenario."""

    section: str
    name: str
    kind: str
    default: str
    meaning: str


def scenario_keys() -> Iterator[Key]:
    """Yield every key of a scenario, the keys of each section together."""
    schema = json.loads(schema_text())
    definitions = schema["$defs"]

    def objects(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """Yield the objects that a node allows; for a list, those that it may hold."""
        if "$ref" in node:
            yield from objects(definitions[node["$ref"].rpartition("/")[2]])
        elif "anyOf" in node:
            for each in node["anyOf"]:
                yield from objects(each)
        elif node.get("type") == "array" and isinstance(node.get("items"), dict):
            yield from objects(node["items"])
        elif "properties" in node:
            yield node

    def kind_of(field: dict[str, Any]) -> str:
        kinds = []
        for each in field.get("anyOf", [field]):
            if "$ref" in each:
                own = definitions[each["$ref"].rpartition("/")[2]]
                kinds.append(kind_of(own) if "enum" in own else "section")
            else:
                choices = " or ".join(map(str, each.get("enum", [])))
                kinds.append(choices or str(each.get("const", each.get("type", "any"))))
        return ", ".join(dict.fromkeys(kinds))

    def keys_of(nodes: list[dict[str, Any]], section: str) -> Iterator[Key]:
        fields: dict[str, tuple[dict[str, Any], bool]] = {}
        for node in nodes:
            for name, field in node["properties"].items():
                fields.setdefault(name, (field, name in node.get("required", [])))
        for name, (field, required) in fields.items():
            default = json.dumps(field["default"]) if "default" in field else ""
            known = "required" if required else default if len(default) < LONGEST_DEFAULT else ""
            yield Key(section, name, kind_of(field), known, field["description"])
        for name, (field, _) in fields.items():
            if inner := [*objects(field)]:
                yield from keys_of(inner, f"{section}.{name}".lstrip("."))

    yield from keys_of([*objects(schema)], "")


LONGEST_DEFAULT = 60  # characters; longer ones are those of sections


def scenario_page() -> str:
    """Return the page of all scenario keys."""
    about = (
        "Written from the code. [Scenarios](../scenarios.md) explains how the keys work together."
    )
    parts = [f"# Scenario keys\n\n{about} Units are in brackets.\n"]
    for section, keys in itertools.groupby(scenario_keys(), key=lambda key: key.section):
        parts.append(f"## {f'`{section}`' if section else 'Top level'}\n")
        parts.append("| Key | Type | Default | Meaning |\n|---|---|---|---|")
        for key in keys:
            default = f"`{key.default}`" if key.default not in ("", "required") else key.default
            cells = (f"`{key.name}`", key.kind, default, key.meaning)
            parts.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
        parts.append("")
    return "\n".join(parts)


def metric_page() -> str:
    """Return the page of the metrics that `expect` bounds."""
    about = (
        "Names for `expect` ([a gate in a CI](../ci_gate.md)). Each is one number for all seeds of "
        "a scenario; the meaning says how seeds and robots are combined. Units end the names: "
        "`_m`, `_rad`, `_kb`; others are ratios, shares or counts."
    )
    parts = [f"# Metrics\n\n{about}\n"]

    def add(title: str, rows: Mapping[str, str]) -> None:
        parts.append(f"## {title}\n\n| Metric | Meaning |\n|---|---|")
        parts.extend(f"| `{name}` | {meaning} |" for name, meaning in rows.items())
        parts.append("")

    def meaning(of: Any) -> str:
        text = inspect.getdoc(getattr(of, "func", of)) or ""
        text = " ".join(text.split()).removeprefix("Return ").removesuffix(".")
        which = getattr(of, "keywords", {}).get("variant", "")
        if "column" in text:
            return f"{text}; here: {MEANING[which]}"
        return f"{text}; here: `{which}`" if which and " or " in text else text

    add("Of a run", {name: meaning(METRICS[name]) for name in settings.RUN_METRICS})
    of_aligners = {f"ALIGNER.{name}": meaning(of) for name, of in ALIGNER_METRICS.items()}
    add("Of each aligner", of_aligners)
    columns = {f"FUSER.{name}": MEANING[name] for name in settings.FUSER_METRICS}
    median = {name: f"{text}; at the end, median over seeds" for name, text in columns.items()}
    add("Of each fuser", median)
    return "\n".join(parts)


def command_page() -> str:
    """Return the page of all commands and their options."""
    root = typer.main.get_command(command_line)
    parts = [
        "# Command line\n",
        "Written from the code: `mapfusion COMMAND --help` prints the same.\n",
    ]

    def add(name: str, command: Any) -> None:
        for child, own in sorted(getattr(command, "commands", {}).items()):
            add(f"{name} {child}", own)
        if getattr(command, "commands", None):
            return
        parts.append(f"## {name}\n\n{inspect.cleandoc(command.help or '')}\n")
        rows = []
        for parameter in command.params:
            shown = " ".join((*parameter.opts, *parameter.secondary_opts))
            if parameter.param_type_name == "argument":
                shown = parameter.metavar or parameter.name.upper()
            about = " ".join((getattr(parameter, "help", "") or "").split()).replace("|", "\\|")
            rows.append(f"| `{shown}` | {about} |")
        if rows:
            parts.append("| Argument or option | Meaning |\n|---|---|\n" + "\n".join(rows) + "\n")

    add("mapfusion", root)
    return "\n".join(parts)


def api_page() -> str:
    """Return the page of the public names of the library."""
    about = "`import mapfusion` offers these names. [Library](../library.md) shows their use."
    parts = [f"# Python API\n\n{about}\n"]
    for name in sorted(vars(mapfusion)["__all__"], key=str.lower):
        value = getattr(mapfusion, name)
        if inspect.isclass(value):
            kind = "autoexception" if issubclass(value, BaseException) else "autoclass"
            parts.append(f"```{{eval-rst}}\n.. {kind}:: mapfusion.{name}\n   :members:\n```\n")
        elif callable(value):
            parts.append(f"```{{eval-rst}}\n.. autofunction:: mapfusion.{name}\n```\n")
    return "\n".join(parts)


def write_reference(_: Sphinx) -> None:
    """Write the pages of the reference that come from the code."""
    REFERENCE.mkdir(exist_ok=True)
    pages = {"scenario_keys": scenario_page, "command_line": command_page, "api": api_page}
    pages |= {"metrics": metric_page}
    for name, page in pages.items():
        (REFERENCE / f"{name}.md").write_text(page(), encoding="utf-8")


def write_examples(app: Sphinx) -> None:
    """Run the examples; write a page of each with its output and picture."""
    source = Path(app.srcdir)
    folder = source / "reference" / "examples"
    folder.mkdir(parents=True, exist_ok=True)
    programs = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    settings = os.environ | {
        "MPLBACKEND": "Agg",
        "PATH": programs,  # with the command `mapfusion` of this environment
        "PYTHONPATH": str(source.parent),
    }
    for program in sorted((source / "examples").glob("*.py")):
        page = folder / f"{program.stem}.md"
        code = program.read_text(encoding="utf-8")
        title, _, about = (ast.get_docstring(ast.parse(code)) or "").partition("\n")
        with tempfile.TemporaryDirectory() as place:
            ran = subprocess.run(  # noqa: S603  # our own programs
                [sys.executable, str(program), str(source.parent)],
                cwd=place,
                env=settings,
                capture_output=True,
                text=True,
            )
            if ran.returncode:
                raise ExtensionError(f"{program.name} failed: {ran.stderr.strip()}")
            shutil.copy(Path(place) / "picture.png", folder / f"{program.stem}.png")
        body = code.split('"""\n', 1)[-1].strip()
        page.write_text(
            f"# {title.rstrip('.')}\n\n{about.strip()}\n\n```python\n{body}\n```\n\n"
            f"Output:\n\n```text\n{ran.stdout}```\n\n![{title}]({program.stem}.png)\n",
            encoding="utf-8",
        )


def write_math(translator: Any, node: nodes.math) -> None:
    """Write an equation in a line as MathML."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def write_math_block(translator: Any, node: nodes.math_block) -> None:
    """Write an equation on lines of its own as MathML."""
    translator.body.append(convert(node.astext(), display="block"))
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Draw equations as MathML; write reference and examples before the pages are read."""
    app.add_html_math_renderer("mathml", (write_math, None), (write_math_block, None))
    app.connect("builder-inited", write_reference)
    app.connect("builder-inited", write_examples)
