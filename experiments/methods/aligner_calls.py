"""How the harness calls a method: our own in place, others' in a process of their own."""

import functools
from typing import Any

import numpy as np

from experiments.methods.catalogue import find_method, make_method
from experiments.methods.installed import Kind
from experiments.methods.isolation import (
    ChildFailedError,
    IsolatedAligner,
    Spec,
    child_for,
    spec_of,
)
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.registration import Aligner, as_aligner
from mapfusion.align.result import Alignment, Status, without_answer
from mapfusion.landmark_map import LandmarkMap


class AbsentAligner:
    """Stands for a method whose package is not installed: every answer says so."""

    def __init__(self, reason: str) -> None:
        self.randomised = False
        self._reason = reason

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """The status `absent`."""
        del map_a, map_b, rng
        return without_answer(Status.ABSENT, self._reason, len(correspondences))


def callable_aligner(method: str, parameters: dict[str, Any], time_limit_s: float) -> Aligner:
    """The aligner, ready to be called; raises ValueError for an unknown name or parameter."""
    found = find_method(method)
    if found.kind is Kind.BUILT_IN:
        return as_aligner(make_method(method, **parameters))
    if found.absence:
        return AbsentAligner(found.absence)
    return IsolatedAligner(method, parameters, time_limit_s)


def require_usable(method: str, parameters: dict[str, Any]) -> None:
    """Have the method made once, a plug-in in a process of its own.

    Raises:
        ValueError: the name or a parameter is unknown, or a parameter is out of range.
    """
    if find_method(method).kind is Kind.PLUG_IN:
        _require_made(spec_of(method, parameters))
    else:
        make_method(method, **parameters)


@functools.cache  # a sweep validates the same few again and again
def _require_made(spec: Spec) -> None:
    try:
        child_for(spec)
    except ChildFailedError as error:
        raise ValueError(f"plug-in {spec.method}: {error}") from error
