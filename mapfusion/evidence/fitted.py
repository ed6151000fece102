"""Coefficients of `probability.py`.

`python -m experiments.study.refusal.fit_probability` writes them anew. These are its model's, of
3071 alignments, 1935 of them right, on stored maps of alias, full, posters and posters_apart, of as
many of the seeds 0 to 9 as there were; the filter has changed a little since.
"""

VERSION = 1
INTERCEPT = -1.341
WEIGHTS = (0.629, 2.968, 0.453, 0.43, -2.225, -6.661)
