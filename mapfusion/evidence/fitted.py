"""Coefficients of `probability.py`.

As `python -m experiments.study.refusal.fit_probability` fits them.

Of 6020 alignments, 4158 of them right, of seeds 0 to 4 of alias_copy, alias_copy_apart,
alias_light, alias_mirror, alias_posters, alias_posters_apart, alias_rooms, alias_rooms_apart,
full without apart, posters, posters_apart.
"""

VERSION = 3
INTERCEPT = -0.248
WEIGHTS = (0.196, 0.726, 2.923, -1.906, 0.491, -2.040, -6.518)
