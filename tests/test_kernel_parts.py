"""Parts of kernels and inner kernels: who calls them.

Parts are put into few places, all of which divide by zero as they do.
"""

import ast
from collections import defaultdict

import numpy as np
import pytest

from experiments.pipeline.code_version import PACKAGES, SOURCE_ROOT
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import source_of

_MOST_COPIED = 20  # statements; more of them take longer to compile than a kernel apart

KERNELS = {"kernel", "inner_kernel", "kernel_part"}  # decorators

Named = tuple[str, str]  # a module and a function

TREES = {
    ".".join(path.relative_to(SOURCE_ROOT).with_suffix("").parts): ast.parse(path.read_bytes())
    for package in PACKAGES
    for path in sorted((SOURCE_ROOT / package).rglob("*.py"))
}
FUNCTIONS: dict[Named, ast.FunctionDef] = {
    (module, node.name): node
    for module, tree in TREES.items()
    for node in tree.body
    if isinstance(node, ast.FunctionDef)
}


def decorator(node: ast.FunctionDef) -> tuple[str, str]:
    """The name of its only decorator and what that is given; empty where there is none."""
    name, _, options = "".join(ast.unparse(each) for each in node.decorator_list).partition("(")
    return name, options


def meant_in(module: str) -> dict[str, Named]:
    """The functions that names stand for in a module: its own, and those it imports."""
    meant = {name: (home, name) for home, name in FUNCTIONS if home == module}
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.ImportFrom) and node.module:
            meant |= {one.name: (node.module, one.name) for one in node.names}
    return meant


def found_uses() -> dict[Named, list[ast.FunctionDef]]:
    """By function, the functions that name it, once for each time that they do."""
    uses = defaultdict[Named, list[ast.FunctionDef]](list)
    for module, tree in TREES.items():
        meant = meant_in(module)
        for caller in (node for node in tree.body if isinstance(node, ast.FunctionDef)):
            for node in ast.walk(caller):
                if isinstance(node, ast.Name) and node.id in meant:
                    uses[meant[node.id]].append(caller)
    return uses


USES = found_uses()
PARTS = [named for named, node in FUNCTIONS.items() if decorator(node)[0] == "kernel_part"]


def test_parts_are_found() -> None:
    assert len(PARTS) > 100


@pytest.mark.parametrize("part", PARTS, ids=".".join)
def test_a_part_is_called_by_kernels_alone_that_divide_as_it_does(part: Named) -> None:
    _, options = decorator(FUNCTIONS[part])
    callers = {decorator(caller) for caller in USES[part]}
    assert callers
    assert callers <= {(kind, options) for kind in KERNELS}


@pytest.mark.parametrize("part", PARTS, ids=".".join)
def test_a_part_that_is_called_at_several_places_is_short(part: Named) -> None:
    assert (len(USES[part]) - 1) * len(FUNCTIONS[part].body) <= _MOST_COPIED


INNER = {named for named, node in FUNCTIONS.items() if decorator(node)[0] == "inner_kernel"}


def test_inner_kernels_are_found() -> None:
    assert len(INNER) > 30


def test_an_inner_kernel_called_from_python_says_so_and_ends_nothing() -> None:
    with pytest.raises(TypeError, match="moved_point: only kernels can call it"):
        se2.moved_point(np.zeros(3), 1.0, 0.0, 1.0, 1.0)
    assert source_of(se2.moved_point)(np.ones(3), 1.0, 0.0, 1.0, 1.0) == (2.0, 2.0)


@pytest.mark.parametrize("module", TREES)
def test_an_inner_kernel_is_called_by_kernels_alone(module: str) -> None:
    """Elsewhere it is named only for the function that it was made of (`source_of`)."""
    meant, allowed = meant_in(module), set[ast.AST]()
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.FunctionDef) and decorator(node)[0] in KERNELS:
            allowed.update(ast.walk(node))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "source_of":
            allowed.update(node.args)
    assert not [
        (node.id, node.lineno)
        for node in ast.walk(TREES[module])
        if isinstance(node, ast.Name) and meant.get(node.id) in INNER and node not in allowed
    ]
