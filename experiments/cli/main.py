"""The command `mapfusion`: its list of commands, and what becomes of their failures."""

import io
import os
import re
import sys
import warnings
from typing import Annotated, Any

import typer

import mapfusion
from experiments.cli import import_commands, run_commands, step_commands, study_commands
from experiments.cli.options import (
    EXIT_BAD_INPUT,
    EXIT_DEFECT,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    STEPS,
    complain,
)
from mapfusion.errors import InputError, one_line

_THREAD_COUNTS = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"),
    *("NUMEXPR_NUM_THREADS", "NUMEXPR_MAX_THREADS"),
)

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Measures how well landmark maps of independent robots can be fused.\n\n"
    "Start with:  mapfusion run quick",
)
for commands in (run_commands, study_commands, step_commands):
    app.add_typer(commands.app)
app.add_typer(import_commands.app, name="import", rich_help_panel=STEPS)


def _tell_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mapfusion {mapfusion.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", help="Tell the version.", callback=_tell_version, is_eager=True),
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command; every failure a user can cause is one line and an exit code."""
    from experiments.pipeline.code_version import use_kernel_cache
    from experiments.pipeline.workers import save_defect

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # None without a terminal
            stream.reconfigure(errors="replace")  # whatever the terminal's encoding lacks
    # Work is bound to one thread anyway, and those that BLAS starts when it is imported wait in a
    # loop. To be said before that.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ["MPLBACKEND"] = "agg"  # figures go to files; a name unknown here ends the import
    _mend_thread_counts()
    _tell_warnings()
    try:
        use_kernel_cache()
        code = app(prog_name="mapfusion", standalone_mode=False) or 0
    except InputError as error:
        for line in str(error).splitlines():
            complain(line)
        code = EXIT_BAD_INPUT
    except BrokenPipeError:
        code = EXIT_FAILED
    except OSError as error:  # a full disk, a folder that is a file or not ours
        where = "" if error.filename is None else f"{error.filename}: "
        complain(one_line(f"{where}cannot be read or written ({error.strerror or error})"))
        code = EXIT_BAD_INPUT
    except MemoryError:
        kept = "what was finished is kept; --jobs 1 needs least"
        complain(f"this machine has too little memory for this ({kept})")
        code = EXIT_BAD_INPUT
    except KeyboardInterrupt:  # before or after what the command itself guards
        code = EXIT_INTERRUPTED
    except Exception as error:
        # Typer keeps its usage errors' classes private; all of them can tell their message.
        message = getattr(error, "format_message", None)
        if message is None:
            complain(save_defect(error))
            code = EXIT_DEFECT
        else:
            if message():  # empty where the help was shown instead
                complain(f"{message()} (see mapfusion --help)")
            code = EXIT_BAD_INPUT
    if code == EXIT_INTERRUPTED:
        complain("interrupted; what was finished is kept, the same command goes on from there")
    sys.exit(code)


def _mend_thread_counts() -> None:
    """Take one thread where a variable names no number of them, and say so.

    Libraries read these variables when they are imported, and some fail then. OpenMP allows a list
    with a number for each level of nesting; other libraries do not.
    """
    for name in _THREAD_COUNTS:
        given = os.environ.get(name)
        first = (given or "1").split(",")[0].strip()
        is_count = re.fullmatch("0*[1-9][0-9]{0,4}", first) is not None
        if given is None or (is_count and first == given):
            continue
        os.environ[name] = first if is_count else "1"
        if not is_count:
            complain(f"warning: {name}={one_line(given)}: is no number of threads; 1 is taken")


def _tell_warnings() -> None:
    """Show each of our warnings in one line; others keep Python's own form."""
    from mapfusion.errors import TellingWarning

    show = warnings.showwarning

    def tell(message: Warning | str, category: type[Warning], *rest: Any) -> None:
        if issubclass(category, TellingWarning):
            complain(f"warning: {message}")
        else:
            show(message, category, *rest)

    warnings.showwarning = tell
    warnings.simplefilter("always", TellingWarning)  # two stages may be damaged in one way


if __name__ == "__main__":
    main()
