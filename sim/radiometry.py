"""What a camera's sensor adds to the light that it sees."""

from dataclasses import dataclass
from typing import Annotated

from mapfusion.arguments import Range, require_in_range


@dataclass(frozen=True)
class RadiometricNoise:
    """Sensor noise, independent in the two images of a pair.

    Attributes:
        sigma_gray: standard deviation of each pixel's additive noise, in gray levels of 255.
        gain: mean gain; below 1 the pictures are dark, and the noise is not.
        sigma_gain: standard deviation of an image's gain, relative to the mean gain.
        sigma_offset_gray: standard deviation of an image's offset, in gray levels.
        gamma: power of the light, over the full range, that the gain is applied to: other than 1
            it takes contrast from the dark (above) or from the bright (below).
    """

    sigma_gray: Annotated[float, Range(0, 255, "grey levels")] = 2.0
    sigma_gain: Annotated[float, Range(0, 10, "1")] = 0.01
    sigma_offset_gray: Annotated[float, Range(0, 255, "grey levels")] = 1.0
    gain: Annotated[float, Range(0, 10, "1")] = 1.0
    gamma: Annotated[float, Range(0.1, 10, "1")] = 1.0

    def __post_init__(self) -> None:
        require_in_range(self)
