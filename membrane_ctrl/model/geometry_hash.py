"""The hash that identifies a geometry in results and runs."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

SCHEMA = "membrane-geometry/1"
_HASHED = ("geometry", "covariance", "parameters", "camera", "pattern")


def hash_content(tables: Mapping[str, Any]) -> str:
    """Sixteen digits that identify a geometry in results and runs, whatever the order or layout of
    its tables.
    """
    content = {key: tables[key] for key in _HASHED if key in tables}
    text = json.dumps(content, sort_keys=True, default=list)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
