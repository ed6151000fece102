"""The paper's fuser with what its covariances leave out: the drift of the maps."""

from mapfusion.fuse.component import Component
from mapfusion.fuse.kalman import kalman_fused
from mapfusion.fuse.parameters import MergeParameters
from mapfusion.fuse.sequential import fused_in_turn
from mapfusion.fused_map import FusedMap


class KalmanDrift:
    """With S + s_drift^2 I in place of the paper's S."""

    smoothed = False

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the component's members."""
        return fused_in_turn(component, parameters, kalman_fused, use_drift=True)
