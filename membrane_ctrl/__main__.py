"""`membrane-ctrl` and `python -m membrane_ctrl`.

Kept thin: child processes started with `spawn` import this module again.
"""

import sys


def main() -> None:
    """Run the command line and exit with its code."""
    from membrane_ctrl.cli import run

    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
