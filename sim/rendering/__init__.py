"""A renderer of our own worlds: upright walls of one height, a floor, a ceiling and the robots.

In plan a pixel column of a level camera is a wedge, and what it sees is the nearest wall, all the
way up (`plan`); above and below it lie ceiling and floor. So walls are drawn column by column and
levels row by row, each pixel the mean of what its footprint covers (`wall_columns`, `levels`,
`picture`), and over them the other robots (`robots`). Or each pixel is the texel that its middle
hits, as PyBullet's TinyRenderer has it.
"""
