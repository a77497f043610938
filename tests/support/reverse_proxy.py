"""A real nginx before a service, for tests."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from tests.support.machine_needs import program_path

_START_S = 30.0
_CONFIGURATION = """daemon off;
worker_processes 1;
pid {folder}/nginx.pid;
error_log {folder}/nginx-errors.txt;
events {{ worker_connections 256; }}
http {{
  access_log off;
  client_body_temp_path {folder}/bodies;
  proxy_temp_path {folder}/proxied;
  fastcgi_temp_path {folder}/fastcgi;
  uwsgi_temp_path {folder}/uwsgi;
  scgi_temp_path {folder}/scgi;
  server {{
    listen 127.0.0.1:{port};
    location {location} {{
      proxy_pass {target};
      proxy_http_version 1.1;
      proxy_set_header Upgrade $http_upgrade;
      proxy_set_header Connection "upgrade";
      {headers}
    }}
    {rest}
  }}
}}
"""


@asynccontextmanager
async def reverse_proxy(
    folder: Path, port: int, location: str, target: str, headers: str = ""
) -> AsyncIterator[None]:
    """An nginx that passes what is under `location` on to `target`; other paths get 404."""
    rest = "" if location == "/" else "location / { return 404; }"
    text = _CONFIGURATION.format(
        folder=folder, port=port, location=location, target=target, headers=headers, rest=rest
    )
    file = _write_configuration(folder, text)
    words = [
        program_path("nginx"),
        "-p",
        str(folder),
        "-e",
        str(folder / "nginx-errors.txt"),
        "-c",
        str(file),
    ]
    process = await asyncio.create_subprocess_exec(*words)
    try:
        async with asyncio.timeout(_START_S):
            while not await _listens(port):
                assert process.returncode is None, (folder / "nginx-errors.txt").read_text()
                await asyncio.sleep(0.05)
        yield
    finally:
        process.terminate()
        await process.wait()


def _write_configuration(folder: Path, text: str) -> Path:
    folder.mkdir()
    file = folder / "nginx.conf"
    file.write_text(text)
    return file


async def _listens(port: int) -> bool:
    try:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
    except OSError:
        return False
    writer.close()
    return True
