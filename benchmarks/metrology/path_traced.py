"""Sets rendered by Mitsuba, a path tracer: the committed ones, and how exact the renderer is.

It needs the extra `render`.

`python -m benchmarks.metrology.path_traced sets [NAME ...]` renders the committed sets again;
`... sphere` compares a rendered spherical mirror with the closed form, in double precision;
`... campaign [N]` renders and measures N random benches (20), resumable, and writes
docs/measurements/path-traced.md. A variant of Mitsuba as last argument, `llvm_ad_rgb`, is twice
as fast as `scalar_rgb`; it needs LLVM 19 (Debian: `libllvm19`; DRJIT_LIBLLVM_PATH names the file).
"""

from __future__ import annotations

import sys

import cv2

from tests.studies.path_traced_benches import renderer_error, write_campaign_page
from tests.worlds.path_traced.committed_sets import FOLDER, committed_sets

VARIANTS = ("scalar_rgb", "llvm_ad_rgb")
BENCHES = 20


def write_sets(names: list[str], variant: str) -> None:
    """Render committed sets; all without names."""
    for seed, (name, one) in enumerate(committed_sets().items(), start=1):
        if names and name not in names:
            continue
        one.write(FOLDER / name, seed, variant)
        for path in (FOLDER / name).glob("*.png"):
            picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        print(f"{FOLDER / name} written")


def main(arguments: list[str]) -> None:
    """Do what the first argument names."""
    variants = [argument for argument in arguments if argument in VARIANTS]
    variant = variants[0] if variants else VARIANTS[0]
    rest = [argument for argument in arguments if argument not in VARIANTS]
    if rest[:1] == ["sets"]:
        write_sets(rest[1:], variant)
    elif rest[:1] == ["sphere"]:
        print(renderer_error(variant=variant).sentence())
    elif rest[:1] == ["campaign"]:
        write_campaign_page(int(rest[1]) if len(rest) > 1 else BENCHES, variant)
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
