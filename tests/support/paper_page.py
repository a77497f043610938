"""`docs/paper` from a finished document: `python -m tests.support.paper_page FOLDER`.

FOLDER is what `membrane-ctrl paper --out FOLDER` wrote. The page has the comparisons as tables and
the pictures; `paper.json` holds the numbers, which a test computes again.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

from membrane_ctrl.paper.comparison import Agreement
from membrane_ctrl.paper.parts import PARTS

DOCS = Path(__file__).parents[2] / "docs" / "paper"
_BEGIN = """# The paper, computed again

{summary}

`membrane-ctrl paper` (or `make paper`) makes this page's content as HTML and PDF from simulated
frames of the paper's bench; `--sets RUN_OF_SETS` from recorded frames, `--only PART` one part. This
page: {shrink}, {sets} sets, {trials} trials, seed {seed}.

| | by the clock, with other work on both cores | time of one core | memory |
|---|---|---|---|
| `--quick`: a sixth of the pixels along a side, 160 sets, 40 trials | 1 min 8 s | 53 s | 0.5 GB |
| half of the pixels along a side (default) | 3 min 11 s | 2 min 20 s | 0.8 GB |
| `--full-size` | 5 min 23 s | 4 min 18 s | 1.5 GB |

## Where the paper can be read in several ways

- **Equation 12**: its tan(theta) is -dh/dx, if h is the height along z as equation 15 has it.
- **The y equations** are not given. The camera stands in the xz plane: seen along x, its angle is
  90 degrees and a becomes a sin(alpha). The screen is inclined to that view, so that b is the
  height of each point of it; with that the equations are exact.
- **Equation 14** takes both angles from arccosines, which have no sign. In y the angles need signs.
- **x_0 and y_0** of a pixel depend on the height, which is unknown: here a pixel keeps its ray.
- **The Monte Carlo** does not say whether a pixel keeps its ray or its x and y when alpha is wrong,
  nor what alpha does in the y equations: by geometry it acts there with the opposite sign. No
  reading gives 24.8 µm.
- **4 to 5 µm of a pair** are the uncertainty of its change by Monte Carlo, not the change.
- **Pitch of the screen**: eight periods of 49.82 mm do not fit on 768 pixels of 0.51 mm.
- **1e-16 mm** between solutions is less than double precision resolves at the edge, 31 mm
  high.
"""


def make_page(table: dict[str, Any], pictures: dict[str, list[tuple[str, str]]]) -> str:
    """The page; `pictures` are title and file of each part's."""
    agreements = [row[3] for rows in table["comparisons"].values() for row in rows]
    summary = ", ".join(f"{agreements.count(name)} {name}" for name in Agreement)
    summary = f"Of {len(agreements)} comparisons: {summary}."
    share = "all pixels of the paper's camera"
    if table["shrink"] > 1:
        share = f"1/{table['shrink']} of the paper's pixels along a side"
    sizes = {name: table[name] for name in ("sets", "trials", "seed")}
    lines = [_BEGIN.format(summary=summary, shrink=share, **sizes)]
    for part in PARTS:
        if part.name not in table["comparisons"]:
            continue
        lines += [
            f"## {part.title}",
            "",
            f"{part.source}; `membrane-ctrl paper --only {part.name}`",
        ]
        lines += ["", "| quantity | the paper | here | | note |", "|---|---|---|---|---|"]
        rows = table["comparisons"][part.name]
        lines += ["| " + " | ".join(cell.replace("|", "/") for cell in row) + " |" for row in rows]
        lines.append("")
        lines += [f"![{title}]({file})\n" for title, file in pictures[part.name]]
    return "\n".join(lines)


def main() -> int:
    """Write the page, its numbers and pictures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    DOCS.mkdir(exist_ok=True)
    for old in DOCS.iterdir():
        old.unlink()
    table = json.loads((folder / "paper.json").read_text())
    pictures: dict[str, list[tuple[str, str]]] = {}
    for name in table["comparisons"]:
        titles = json.loads((folder / "parts" / f"{name}.json").read_text())["pictures"]
        pictures[name] = [(title, f"{name}-{k + 1}.png") for k, title in enumerate(titles)]
        for _, file in pictures[name]:
            shutil.copyfile(folder / "parts" / file, DOCS / file)
    (DOCS / "index.md").write_text(make_page(table, pictures))
    (DOCS / "paper.json").write_text(json.dumps(table, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
