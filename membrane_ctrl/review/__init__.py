"""Review of runs: reading, statistics, detected events, reports, the viewer.

`open_run(path)` is the entry point for programs: columns as Arrow tables, shapes and maps as
arrays, events as dicts.
"""

from membrane_ctrl.run_files.run import Run, open_run
from membrane_ctrl.run_files.shapes import Shapes

__all__ = ["Run", "Shapes", "open_run"]
