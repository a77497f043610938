"""A Dask cluster of two workers on this machine, as a process of its own."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    local = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(n_workers=2, threads_per_worker=1, **local) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""
# Dask gives up on a busy machine that answers late
PATIENT = {f"DASK_DISTRIBUTED__COMM__TIMEOUTS__{name}": "900s" for name in ("CONNECT", "TCP")}


@contextmanager
def cluster(folder: Path) -> Iterator[str]:
    """Run it, with its script in a folder, and yield the scheduler's address."""
    script = folder / "cluster.py"
    script.write_text(CLUSTER)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(
        [sys.executable, script], text=True, env=os.environ | PATIENT, **pipes
    ) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.stdin.close()
