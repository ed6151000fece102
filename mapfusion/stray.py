"""How far the points that tracks follow lie from their landmarks."""

# A corner's pixels settle on another point of it in each track: on the wall by 3 to 4 mm along each
# axis, whatever the distance. It repeats in all sightings of a track and does not average out.
STRAY_M = 0.004
