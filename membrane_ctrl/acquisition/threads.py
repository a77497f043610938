"""Limits the numerical threads of the acquisition: the control process's tick needs a core."""

import os

# The kernels use two threads of their own (metrology.threads). Matrices are small here, terms x
# terms: more than one thread would only spin.
_LIMITS = {
    "NUMBA_NUM_THREADS": "2",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}


def limit_threads() -> None:
    """Set the limits. Call before importing NumPy, OpenCV and numba, which read them only at
    import.
    """
    os.environ.update(_LIMITS)
