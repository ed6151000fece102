"""One thread for what happens inside a process."""

from threadpoolctl import threadpool_limits


def single_threaded() -> None:
    """Bind BLAS and OpenCV to one thread: several would change the order of sums.

    Only libraries that are loaded can be bound, and SciPy brings a BLAS of its own.
    """
    import cv2
    import numpy as np  # noqa: F401
    import scipy.linalg  # noqa: F401

    cv2.setNumThreads(1)
    threadpool_limits(1)
