"""How maps are merged, whatever fuser does it."""

from dataclasses import dataclass, field
from typing import Annotated

from mapfusion.align.correspondences import HeightGate
from mapfusion.arguments import Probability, Range, require_in_range
from mapfusion.same_point import SamePoint
from mapfusion.team.team_graph import TeamParameters


@dataclass(frozen=True)
class MergeParameters:
    """How maps are merged.

    Attributes:
        team: which alignments of more than two maps are believed.
        max_descriptor_distance: of landmarks that are taken for one point though no alignment names
            them; with labels on both sides these decide instead.
        gate_probability: of keeping two landmarks of one point there (chi-square, 2 degrees of
            freedom, drift included; in joint fusion of the Student-t that is fitted).
        height: which landmarks can have one height (not for planar maps and joint covariances).
        use_alignment_uncertainty: add J S_T J^T, the covariance of the map's place to first order,
            to the landmarks that the Kalman fusers move. The paper does not. This error is common
            to all of them, which per-landmark covariances cannot say; and as it is told from the
            first map, the order of the maps then weighs their landmarks.
    """

    team: TeamParameters = field(default_factory=TeamParameters)
    max_descriptor_distance: Annotated[float, Range(1e-3, 2, "1")] = 0.3
    gate_probability: Probability = 0.99
    height: HeightGate = field(default_factory=HeightGate)
    use_alignment_uncertainty: bool = False

    def __post_init__(self) -> None:
        require_in_range(self)

    def same_point(self, planar: bool) -> SamePoint:
        """The test for landmarks that no alignment names."""
        return SamePoint(self.max_descriptor_distance, self.gate_probability, self.height, planar)
