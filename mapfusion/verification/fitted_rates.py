"""Rates of `likelihood.py`: two parameters of what must be seen, and two of what may be.

Written by `python -m experiments.studies.verdict_fitting rates`.

Of 1908 regions under right motions and 2659 under wrong ones, of seeds 0 to 4 of
full, alias_light, alias_light_apart. Of the right ones 0.4% are as under a wrong one.
"""

RIGHT = (12.29, 2.33), (1.74, 2.78)
WRONG = (1.18, 15.39), (0.89, 16.19)
