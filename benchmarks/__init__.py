"""Measured figures, each against a reference of the same run: `make bench` or `python -m benchmarks
[NAME...]`.
"""

import os

os.environ.setdefault(
    "OPENBLAS_NUM_THREADS", "1"
)  # as the product's own processes: a second thread only waits
