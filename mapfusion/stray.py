"""How far the points that tracks follow lie from their landmarks, along each axis.

A corner's pixels settle on another point of it in each track, whatever the distance. It repeats in
all sightings of a track and does not average out.
"""

# Of tracks of one corner: on walls 1 to 2 mm.
STRAY_M = 0.002
# Of what a filter takes for one corner: along its path some are neighbours, a centimetre off.
FILTERED_STRAY_M = 0.004
