"""How many threads the numerics of this process may use: the tick of the control process must find a core."""

from __future__ import annotations

import os

# The kernels split their work over two threads by themselves (metrology.threads). Linear algebra is 36 x 36 here:
# more than one thread would only spin.
_LIMITS = {
    "NUMBA_NUM_THREADS": "2",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}


def limit_threads() -> None:
    """Set the limits. Must come before NumPy, OpenCV and numba are imported: they look once, when they are loaded."""
    os.environ.update(_LIMITS)
