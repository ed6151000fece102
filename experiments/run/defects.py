"""Errors that no input may cause: defects of ours, told in one line, with all that mends them."""

import os
import re
import tempfile
import traceback

# What a process pool puts in place of the traceback of a worker, as text.
_REMOTE = "_RemoteTraceback"
_FRAME = re.compile(r'File "([^"]+)", line (\d+), in (\S+)')
_LONGEST_REASON = 200  # characters


def described(error: BaseException, details: str) -> str:
    """What went wrong and where, in one line; `details` is the error's traceback."""
    frames = _FRAME.findall(details)
    place = "at {}:{} in {}".format(*frames[-1]) if frames else "at an unknown place"
    reason = " ".join(f"{type(error).__name__} {error}".split())[:_LONGEST_REASON]
    return f"a defect of mapfusion itself: {reason} {place}"


def saved_defect(error: BaseException) -> str:
    """The same, once the whole traceback is in a file, which it names.

    What was finished before is in the store, and a repaired program goes on from there.
    """
    cause = error.__cause__
    is_remote = cause is not None and type(cause).__name__ == _REMOTE
    details = str(cause) if is_remote else "".join(traceback.format_exception(error))
    handle, path = tempfile.mkstemp(prefix="mapfusion-defect-", suffix=".txt")
    with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write(details)
    told = "what was finished is kept; please report it with its traceback"
    return f"{described(error, details)}; {told}: {path}"
