"""One thread for what happens inside a process."""

from threadpoolctl import threadpool_limits


def single_threaded() -> None:
    """Bind BLAS and OpenCV to one thread: several would change the order of sums."""
    import cv2

    cv2.setNumThreads(1)
    threadpool_limits(1)
