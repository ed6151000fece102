"""Classes of plug-ins: `module:class` of an installed package, or `FILE.py:CLASS`."""

import importlib
import importlib.util
import re
import sys
from operator import attrgetter
from pathlib import Path
from typing import Any

from mapfusion.errors import did_you_mean

IN_FILE = re.compile(r"(.+\.py):(\w+)")  # a class in a Python file: file and class


def target_in_file(name: str, kind: str) -> str | None:
    """Return `FILE.py:CLASS` with the absolute path of the file; None if the name has another form.

    Args:
        name: name of a method.
        kind: what the class is, for the error.

    Raises:
        ValueError: there is no such file.
    """
    own = IN_FILE.fullmatch(name)
    if own is None:
        return None
    file = Path(own[1])
    if not file.is_file():
        raise ValueError(f"{file}: no such file (expected FILE.py:CLASS of {kind})")
    return f"{file.absolute()}:{own[2]}"


def load_class(target: str) -> Any:
    """Import the class of a target, `module:class` or `FILE.py:CLASS`.

    Raises:
        ValueError: the file has no such class.
        Exception: what the import of the module raises.
    """
    own = IN_FILE.fullmatch(target)
    if own is None:
        module, _, names = target.partition(":")
        return attrgetter(names)(importlib.import_module(module))
    file, name = own.groups()
    # Import the file under a name of its own.
    own_name = f"mapfusion_own_{Path(file).stem}"
    spec = importlib.util.spec_from_file_location(own_name, file)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[own_name] = made  # dataclasses look their module up
    spec.loader.exec_module(made)
    if not hasattr(made, name):
        classes = {key: each for key, each in vars(made).items() if isinstance(each, type)}
        defined = [key for key, each in classes.items() if each.__module__ == own_name]
        there = f"{', '.join(defined) or 'none'}{did_you_mean(name, defined)}"
        raise ValueError(f"{file}: has no class {name}; there: {there}")
    return getattr(made, name)
