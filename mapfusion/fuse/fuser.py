"""What a fuser is."""

from typing import Protocol

from mapfusion.fuse.component import Component
from mapfusion.fuse.parameters import MergeParameters
from mapfusion.fused_map import FusedMap


class Fuser(Protocol):
    """Makes one map of several that believed alignments connect.

    It is made without arguments. What it cannot fuse it carries over; it raises nothing.

    Attributes:
        smoothed: whether it is to be given smoothed maps, where there are any, else the filter's.
    """

    smoothed: bool

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the component's members."""
        ...
