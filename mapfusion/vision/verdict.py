"""What can become of a corner that is looked for in the other image."""

from enum import IntEnum


class Verdict(IntEnum):
    """MATCHED, or why not."""

    MATCHED = 0
    OUTSIDE = 1  # a window leaves an image, or no disparity of the range keeps it inside
    FLAT = 2  # no texture
    WEAK = 3  # nothing in the row correlates
    AMBIGUOUS = 4  # a second place in the row correlates nearly as well
    ONE_SIDED = 5  # the search back from the right image ends elsewhere
    DIVERGED = 6  # the refinement left the pixel that the search had found
    SILHOUETTE = 7  # half of the surroundings lie on another surface
    BENT = 8  # the surroundings show more than one plane, or a surface that is none
