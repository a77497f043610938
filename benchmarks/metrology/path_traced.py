"""Sets rendered by Mitsuba, a path tracer: the committed ones, and how exact the renderer is.

It needs the extra `render`.

`python -m benchmarks.metrology.path_traced sets [NAME ...]` renders the committed sets again;
`... sphere` compares a rendered spherical mirror with the closed form, in double precision;
`... campaign [N]` renders and measures N random benches (20), resumable, and writes
docs/measurements/path-traced.md.
"""

from __future__ import annotations

import sys

import cv2

from tests.studies.path_traced_benches import campaign_page, renderer_error
from tests.worlds.path_traced.committed_sets import FOLDER, committed_sets


def write_sets(names: list[str]) -> None:
    """Render committed sets; all without names."""
    for seed, (name, one) in enumerate(committed_sets().items(), start=1):
        if names and name not in names:
            continue
        one.write(FOLDER / name, seed)
        for path in (FOLDER / name).glob("*.png"):
            picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        print(f"{FOLDER / name} written")


def main(arguments: list[str]) -> None:
    """Do what the first argument names."""
    if arguments[:1] == ["sets"]:
        write_sets(arguments[1:])
    elif arguments[:1] == ["sphere"]:
        print(renderer_error().sentence())
    elif arguments[:1] == ["campaign"]:
        campaign_page(int(arguments[1]) if len(arguments) > 1 else 20)
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
