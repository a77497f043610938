"""The simulated nights of the benchmarks serve these tests too; they live beside the package, not in it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
