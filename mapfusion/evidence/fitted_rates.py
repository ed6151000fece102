"""Rates of `likelihood.py`: two parameters of what must be seen, and two of what may be.

Written by `python -m experiments.study.refusal.fit_rates`.

Of 1884 regions under right motions and 2537 under wrong ones, of seeds 0 to 4 of
full, alias_light, alias_light_apart. Of the right ones 0.2% are as under a wrong one.
"""

RIGHT = (11.16, 2.55), (1.36, 2.72)
WRONG = (1.15, 33.36), (0.57, 24.53)
