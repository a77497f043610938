"""The hash by which results and runs name the geometry that they were made with."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

SCHEMA = "membrane-geometry/1"
_HASHED = ("geometry", "covariance", "parameters", "camera", "pattern")


def content_hash(tables: Mapping[str, Any]) -> str:
    """Sixteen digits that stand for the numbers in a geometry's tables, whatever their order or layout."""
    content = {key: tables[key] for key in _HASHED if key in tables}
    text = json.dumps(content, sort_keys=True, default=list)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
