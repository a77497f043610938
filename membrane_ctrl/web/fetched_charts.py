"""The script with which a browser fetches the options of charts."""

from pathlib import Path

SCRIPT = (Path(__file__).parent / "fetched_charts.js").read_text(encoding="utf-8")
