"""`membrane-ctrl` and `python -m membrane_ctrl`.

Kept thin: child processes started with `spawn` import this module again.
"""

import logging
import os
import sys


def main() -> None:
    """Run the command line and exit with its code."""
    # Matrices are small: a second thread of OpenBLAS would only wait, for a third of the CPU time
    # of `measure`
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # It logs each folder that it cannot write; it works without one
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    from membrane_ctrl.cli import run

    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
