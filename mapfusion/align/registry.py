"""The aligners by name."""

from typing import Any, ClassVar, Protocol

import numpy as np

from mapfusion.align.clique import Clique
from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.gnc import Gnc
from mapfusion.align.icp import Icp
from mapfusion.align.impicp import ImpIcp
from mapfusion.align.ransac import Ransac
from mapfusion.align.ransac_mahalanobis import RansacMahalanobis
from mapfusion.align.result import Alignment
from mapfusion.align.svd import Svd
from mapfusion.landmark_map import LandmarkMap


class Aligner(Protocol):
    """Estimates the motion between two maps from correspondences.

    `randomised` tells whether another generator can give another answer.
    """

    randomised: ClassVar[bool]

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b."""
        ...


ALIGNERS: dict[str, type[Aligner]] = {
    "ransac": Ransac,
    "svd": Svd,
    "icp": Icp,
    "impicp": ImpIcp,
    "gnc": Gnc,
    "clique": Clique,
    "ransac_mahalanobis": RansacMahalanobis,
}


def make_aligner(name: str, **parameters: Any) -> Aligner:
    """Build an aligner by name.

    Raises:
        ValueError: the name or a parameter is unknown, or a parameter is out of range.
    """
    if name not in ALIGNERS:
        raise ValueError(f"name: unknown aligner {name!r}, known are {', '.join(ALIGNERS)}")
    try:
        if isinstance(parameters.get("height"), dict):  # as a scenario file has it
            parameters = parameters | {"height": HeightGate(**parameters["height"])}
        return ALIGNERS[name](**parameters)
    except TypeError as error:
        raise ValueError(f"parameters: {name}: {error}") from error
