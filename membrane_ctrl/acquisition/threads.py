"""How many threads the numerics of this process may use: the tick of the control process must find a core."""

from __future__ import annotations

import os

KERNEL_THREADS = 2  # the live cycle's kernels are written for two cores
_LIBRARY_THREADS = "1"  # linear algebra here is 36 x 36: more threads only spin


def limit_threads() -> None:
    """Limit BLAS, OpenCV and numba. Call it before NumPy is imported: BLAS reads its limit when it is loaded."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = _LIBRARY_THREADS
    import cv2
    import numba

    cv2.setNumThreads(int(_LIBRARY_THREADS))
    numba.set_num_threads(min(KERNEL_THREADS, numba.get_num_threads()))
