"""Ways of a team to one map: who works at what, when, and what is sent for it."""

from dataclasses import dataclass

from mapfusion.fusion.fusers import REFERENCE, USUAL, make_fuser

# What a robot can send, each as the files of our own formats that hold it.
FILTER_MAP = "filter's map"  # landmarks with their own covariances and descriptors
SMOOTHED_MAP = "smoothed map"  # the same with the joint covariance of all of them
LOG = "log"  # odometry and all observations with their descriptors


@dataclass(frozen=True)
class Strategy:
    """A way to one map of the team.

    Attributes:
        name: in tables.
        label: in figures and on the screen.
        fuser: what makes the map.
        sends: what each robot sends for it.
        often: at each iteration that maps are fused at, up to the one that is looked at; else at
            that one alone, as if the drive ended there.
    """

    name: str
    label: str
    fuser: str
    sends: str
    often: bool = False

    @property
    def smooths(self) -> bool:
        """Whether robots smooth their logs for it."""
        return make_fuser(self.fuser).smoothed

    def asked(self, iterations: tuple[int, ...], at: int) -> list[int]:
        """When robots send something and it is fused, for the map of one of these iterations."""
        return [k for k in iterations if k <= at] if self.often else [at]


STRATEGIES = (
    Strategy("filters", "filters alone, fused once", "kalman-drift", FILTER_MAP),
    Strategy("once", "smoothed alone, fused once", USUAL, SMOOTHED_MAP),
    Strategy("anew", "smoothed alone, fused anew", USUAL, SMOOTHED_MAP, often=True),
    Strategy("together", "all logs in one smoother", REFERENCE, LOG),
)
FUSERS = tuple(dict.fromkeys(strategy.fuser for strategy in STRATEGIES))
