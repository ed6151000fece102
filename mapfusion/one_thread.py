"""One thread for linear algebra in small blocks.

NumPy and SciPy bring a BLAS each, with threads of its own, and those of the one wait in a loop
while the other computes. Where blocks of some ten rows go to both in turn, as in a factorisation by
envelope, that takes several times as long as one thread does.
"""

from threadpoolctl import threadpool_limits

one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorator: BLAS has one thread while the function runs, and then what it had before."""
