"""The command `mapfusion`: its subcommands, and the handling of their errors."""

import io
import os
import re
import signal
import sys
import warnings
from typing import Annotated, Any

import typer

import mapfusion
from experiments.cli import run_commands, step_commands, study_commands
from experiments.cli.options import (
    EXIT_BAD_INPUT,
    EXIT_DEFECT,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    STEPS,
    print_to_stderr,
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
app.add_typer(step_commands.import_app, name="import", rich_help_panel=STEPS)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mapfusion {mapfusion.__version__}")
        raise typer.Exit


_Version = Annotated[
    bool,
    typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True),
]


@app.callback()
def _options(version: _Version = False) -> None:
    pass


def main() -> None:
    """Run the command; print one line and set the exit code for errors that users can cause."""
    from experiments.pipeline.stage import use_kernel_cache
    from experiments.pipeline.workers import save_defect

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # None without a terminal
            stream.reconfigure(errors="replace")  # characters that the encoding lacks
    # Each process works in one thread, and further threads of BLAS would wait in a busy loop. Must
    # be set before BLAS is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ["MPLBACKEND"] = "agg"  # figures go to files; an unknown name would fail the import
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends a command as Ctrl-C does
    _repair_thread_counts()
    _show_warnings_in_one_line()
    try:
        use_kernel_cache()
        code = app(prog_name="mapfusion", standalone_mode=False) or 0
    except InputError as error:
        for line in str(error).splitlines():
            print_to_stderr(line)
        code = EXIT_BAD_INPUT
    except BrokenPipeError:
        code = EXIT_FAILED
    except OSError as error:  # a full disk, no permission, a file in place of a folder
        where = "" if error.filename is None else f"{error.filename}: "
        print_to_stderr(one_line(f"{where}cannot be read or written ({error.strerror or error})"))
        code = EXIT_BAD_INPUT
    except MemoryError:
        kept = "what was finished is kept; --jobs 1 needs least"
        print_to_stderr(f"this machine has too little memory for this ({kept})")
        code = EXIT_BAD_INPUT
    except KeyboardInterrupt:  # outside the part of the command that handles it
        code = EXIT_INTERRUPTED
    except Exception as error:
        # The classes of Typer's usage errors are private; all have `format_message`.
        message = getattr(error, "format_message", None)
        if message is None:
            print_to_stderr(save_defect(error))
            code = EXIT_DEFECT
        else:
            if message():  # empty if the help was shown
                print_to_stderr(f"{message()} (see mapfusion --help)")
            code = EXIT_BAD_INPUT
    if code == EXIT_INTERRUPTED:
        print_to_stderr(
            "interrupted; what was finished is kept, the same command goes on from there"
        )
    sys.exit(code)


def _repair_thread_counts() -> None:
    """Set invalid environment variables of thread counts to 1, with a warning.

    Libraries read these variables when they are imported, and some fail on invalid values. OpenMP
    allows a list with a number for each level of nesting; other libraries do not.
    """
    for name in _THREAD_COUNTS:
        given = os.environ.get(name)
        first = (given or "1").split(",")[0].strip()
        is_count = re.fullmatch("0*[1-9][0-9]{0,4}", first) is not None
        if given is None or (is_count and first == given):
            continue
        os.environ[name] = first if is_count else "1"
        if not is_count:
            print_to_stderr(
                f"warning: {name}={one_line(given)}: is no number of threads; 1 is taken"
            )


def _show_warnings_in_one_line() -> None:
    """Show warnings for the user in one line; other warnings keep Python's format."""
    from mapfusion.errors import TellingWarning

    show = warnings.showwarning

    def show_ours(message: Warning | str, category: type[Warning], *rest: Any) -> None:
        if issubclass(category, TellingWarning):
            print_to_stderr(f"warning: {message}")
        else:
            show(message, category, *rest)

    warnings.showwarning = show_ours
    warnings.simplefilter("always", TellingWarning)  # the same warning may concern two stages


if __name__ == "__main__":
    main()
