"""A real X server without a screen, and what it shows byte for byte."""

from __future__ import annotations

import os
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.support.machine_needs import require


@contextmanager
def virtual_display(folder: Path, width_px: int, height_px: int) -> Iterator[Path]:
    """Xvfb with a framebuffer file below `folder`; DISPLAY points to it meanwhile."""
    require("Xvfb")
    number_end, server_end = os.pipe()
    command = ["Xvfb", "-displayfd", str(server_end), "-screen", "0", f"{width_px}x{height_px}x24"]
    # without -noreset it resets when its last client leaves, and the next may come too early
    options = ["-fbdir", str(folder), "-nolisten", "tcp", "-noreset"]
    server = subprocess.Popen(
        [*command, *options], pass_fds=[server_end], stderr=subprocess.DEVNULL
    )
    os.close(server_end)
    before = {name: os.environ.get(name) for name in ("DISPLAY", "SDL_VIDEODRIVER")}
    try:
        number = os.read(number_end, 16).decode().strip()  # written when the server is ready
        os.environ.update(DISPLAY=f":{number}", SDL_VIDEODRIVER="x11")
        yield folder / "Xvfb_screen0"
    finally:
        os.close(number_end)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        server.terminate()
        server.wait()


def screenshot(framebuffer: Path) -> NDArray[np.uint8]:
    """(height, width, 3) red, green, blue from the XWD file that the server draws into."""
    content = framebuffer.read_bytes()
    head = struct.unpack(">25I", content[:100])  # XWDFile.h
    header_bytes, width, height, bytes_per_line, colours = (
        head[0],
        head[4],
        head[5],
        head[12],
        head[19],
    )
    start = header_bytes + 12 * colours
    lines = np.frombuffer(content, np.uint8, height * bytes_per_line, start).reshape(
        height, bytes_per_line
    )
    return lines[:, : 4 * width].reshape(height, width, 4)[:, :, 2::-1]
