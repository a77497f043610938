"""The command `measure` on a set of 18 frames of full size, with its pictures: processor time,
time by the clock and memory, from the start of the program to its end.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.simulate import simulate_set
from membrane_ctrl.sim.optics.simulation_spec import SimulationSpec
from tests.support.figures import Figure, at_most

RUNS = 3  # after one that compiles
# The command, and then what it took; its own process sees the largest memory
PROGRAM = """
import json, sys, time
from membrane_ctrl.__main__ import main
from tests.support.peak_memory import peak_mb
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
with open(sys.argv[-1] + ".json", "w") as file:
    json.dump({"busy_s": time.process_time(), "peak_mb": peak_mb()}, file)
"""


def run() -> list[Figure]:
    """All figures: the least of some runs."""
    with tempfile.TemporaryDirectory() as folder:
        capture_set = Path(folder) / "set"
        simulate_set(capture_set, SimulationSpec(OpticsConfig(), typical_film(37.1, 500.0, 1)))
        runs = [_measure_once(capture_set) for _ in range(RUNS + 1)][1:]
        decoded_s = min(_decode_frames(capture_set) for _ in range(RUNS))
    busy_s, passed_s, peak_mb = (min(values) for values in zip(*runs, strict=True))
    decoding = "decoding its frames, s"
    return [
        at_most("18 frames, with pictures: processor", busy_s, "s", 4.0, decoding, decoded_s),
        at_most("by the clock, two cores", passed_s, "s", 3.0, decoding, decoded_s),
        at_most("largest memory", peak_mb, "MB", 600.0),
    ]


def _measure_once(capture_set: Path) -> tuple[float, float, float]:
    """Processor time and time by the clock in s, and largest memory in MB, of one run."""
    out = capture_set.parent / "result"
    command = [sys.executable, "-c", PROGRAM, "measure", str(capture_set), "--out", str(out)]
    begin = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    passed_s = time.perf_counter() - begin
    taken = json.loads(out.with_name("result.json").read_text(encoding="utf-8"))
    return taken["busy_s"], passed_s, taken["peak_mb"]


def _decode_frames(capture_set: Path) -> float:
    """Processor time of decoding the frames alone, on one thread."""
    begin = time.process_time()
    for path in sorted(capture_set.glob("*.png")):
        cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return time.process_time() - begin
