"""Parameters of the verification: matches, evidence and uncertainty."""

from dataclasses import dataclass
from typing import Annotated

from mapfusion.parameters import Range, require_in_range


@dataclass(frozen=True)
class EvidenceParameters:
    """Gates for landmarks seen again, and thresholds of the verdict.

    Attributes:
        gate_m: largest distance between a landmark and its match in the other map. It covers the
            landmarks' covariances, the alignment's uncertainty and the drift of both maps.
        max_descriptor_distance: largest descriptor distance of a match; that of the observations of
            one landmark in the filter.
        region_m: smallest side of a region that counts as one piece of evidence, since neighbouring
            corners belong to one texture. It grows to the largest structure that the maps repeat.
        place_m: longest side of a place that may occur twice as a whole, such as a room. If most of
            the smaller map lies in such a place and agrees, its surroundings were not compared.
        least_ratio: smallest likelihood ratio of the regions, right motion over wrong motion, if
            maps repeat structure or another motion fits; multiplied by the number of motions that
            pass the test against chance. At most one pair of maps in this number has a wrong motion
            that reaches it (Markov's and Boole's inequalities).
        most_against: inverse of the likelihood ratio below which an alignment is contradicted; at
            most one right motion in this number falls below it.
        least_probability: smallest probability that the alignment is right.
        max_sigma_m: largest standard deviation of the other map's landmarks under the alignment,
            RMS. Two standard deviations (95 %) are 0.5 m, the limit of a useful merged map.
        max_sigma_rad: largest standard deviation of the rotation; two standard deviations move a
            landmark at 5 m by 0.5 m.
    """

    gate_m: Annotated[float, Range(0.01, 10, "m")] = 0.3
    max_descriptor_distance: Annotated[float, Range(1e-3, 2, "1")] = 0.5
    region_m: Annotated[float, Range(0.1, 100, "m")] = 2.0
    place_m: Annotated[float, Range(0, 1000, "m")] = 6.0
    least_ratio: Annotated[float, Range(1, 1e12, "1")] = 30.0
    most_against: Annotated[float, Range(1, 1e12, "1")] = 10.0
    least_probability: Annotated[float, Range(0, 1, "1")] = 0.5
    max_sigma_m: Annotated[float, Range(1e-3, 1e6, "m")] = 0.25
    max_sigma_rad: Annotated[float, Range(1e-4, 10, "rad")] = 0.05

    def __post_init__(self) -> None:
        require_in_range(self)
