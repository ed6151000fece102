"""Built-in aligners by name."""

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from mapfusion.align.alignment import Method
from mapfusion.align.clique import Clique
from mapfusion.align.correspondences import HeightGate
from mapfusion.align.gnc import Gnc
from mapfusion.align.icp import Icp, ImpIcp
from mapfusion.align.peers import KissMatcher, OpenCv
from mapfusion.align.ransac import Ransac, RansacMahalanobis
from mapfusion.align.svd import Svd
from mapfusion.errors import did_you_mean

ALIGNERS: dict[str, type[Method]] = {
    "ransac": Ransac,
    "svd": Svd,
    "icp": Icp,
    "impicp": ImpIcp,
    "gnc": Gnc,
    "clique": Clique,
    "ransac_mahalanobis": RansacMahalanobis,
}
PEERS: dict[str, type[Method]] = {"opencv": OpenCv, "kiss_matcher": KissMatcher}


def make_aligner(name: str, /, **parameters: Any) -> Method:
    """Construct a built-in method or peer by name.

    Raises:
        ValueError: the name or a parameter is unknown, or a parameter is out of range.
    """
    own = ALIGNERS | PEERS
    if name not in own:
        known = f"known are {', '.join(own)}{did_you_mean(name, own)}"
        raise ValueError(f"unknown aligner {name!r}, {known}")
    return construct(name, own[name], parameters)


def construct(name: str, constructor: Callable[..., Any], parameters: Mapping[str, Any]) -> Any:
    """Call the constructor of a method with parameters from a scenario file.

    Raises:
        ValueError: a parameter is unknown or out of range.
    """
    made: Any = constructor  # untyped, because is_dataclass would narrow the type to an instance
    known = [own.name for own in fields(made)] if is_dataclass(made) else list(parameters)
    wrong = next((key for key in parameters if key not in known), None)
    if wrong is not None:
        there = f"known: {', '.join(known) or 'none'}{did_you_mean(wrong, known)}"
        raise ValueError(f"parameters: {name}: {wrong}: unknown; {there}")
    try:
        height = parameters.get("height", HeightGate())
        if isinstance(height, dict):
            parameters = {**parameters, "height": HeightGate(**height)}
        elif not isinstance(height, HeightGate):
            raise ValueError(f"parameters: {name}: height: expected probability and floor_m")
        return constructor(**parameters)
    except TypeError as error:
        raise ValueError(f"parameters: {name}: {error}") from error
