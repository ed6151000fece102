"""Settings of the evidence, and of how sure an alignment has to be."""

from dataclasses import dataclass
from typing import Annotated

from mapfusion.parameters import Range, require_in_range


@dataclass(frozen=True)
class EvidenceParameters:
    """What counts as seen again, and how much evidence a verdict needs.

    Attributes:
        gate_m: distance up to which a landmark of the other map is taken for one that must be
            there: covariances, the alignment's own and what both maps drift lie within it.
        max_descriptor_distance: of the two; that of one landmark's sightings in the filter.
        region_m: least side of a region that is one piece of evidence: neighbouring corners are of
            one picture. It grows to the largest thing that the maps hold twice.
        place_m: longest side of a place that a world may hold twice as a whole, a room: where most
            of the smaller map lies within it and agrees, nothing around it has been compared.
        least_ratio: by how many times more likely the regions must be if the alignment is right
            than if it is not, where maps resemble themselves or another motion fits them, and for
            each motion that is more than chance: so that at most one pair of maps of so many has a
            wrong motion that gets there (Markov's and Boole's inequalities).
        most_against: by how many times less likely they may be before it counts as contradicted: at
            most one right motion of so many gets there.
        least_probability: that the alignment is right; below a half it is likelier wrong.
        max_sigma_m: of where an alignment lays the other map's landmarks, RMS over them. Twice
            that, 95 %, is what least squares still mends and what a merged map is used for: 0.5 m.
        max_sigma_rad: of its rotation; twice that moves a landmark at 5 m by as much.
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
