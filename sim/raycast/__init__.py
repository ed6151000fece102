"""A renderer of our own worlds: upright walls of one height, a floor, a ceiling and the robots.

In plan a pixel column of a level camera is a wedge, and what it sees is the nearest wall, all the
way up (`plan`); above and below it lie ceiling and floor. So a picture is drawn column by column,
each pixel the mean of what its footprint covers (`walls`, `levels`, `picture`), or the texel that
its middle hits, as PyBullet's TinyRenderer has it.
"""
