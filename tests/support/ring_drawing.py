"""Draws the mirror's rings, films and ports as far as the paper gives them: docs/images/ring.svg.

    python -m tests.support.ring_drawing

A number that the paper does not give is drawn as a place, not as a size. The bowls are drawn three
times as deep as they are.
"""

from __future__ import annotations

from pathlib import Path

TARGET = Path(__file__).parents[2] / "docs" / "images" / "ring.svg"
WIDTH, HEIGHT = 1000, 620
RADIUS = 210.0  # of the optical surface, in px: 500 mm
MM = RADIUS / 500.0
DEEPER = 3.0  # exaggeration of the bowls
SAG_MM, BULGE_MM = 37.1, 63.4  # the paper's depth; the clear film's by the same law
AXIS_X, AXIS_Y = 300.0, 320.0  # of the section
RING_W, RING_H = 16.0, 34.0
_DEPTHS = "depth of the bowl (sag): 37.1 mm; of the clear film by the same law: 63.4 mm"
FRONT_X = 790.0  # centre of the view of the middle ring


def bowl_path(edge_x: float, depth_px: float) -> str:
    """A film's section: a parabola from the upper rim to the lower one."""
    top, bottom = AXIS_Y - RADIUS, AXIS_Y + RADIUS
    control_x = edge_x + 2 * depth_px
    return f"M {edge_x:.1f} {top:.1f} Q {control_x:.1f} {AXIS_Y:.1f} {edge_x:.1f} {bottom:.1f}"


def text(x: float, y: float, words: str, anchor: str = "start", size: int = 15) -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}" font-size="{size}">{words}</text>'


def line(x1: float, y1: float, x2: float, y2: float, style: str = "") -> str:
    style = style or "stroke:#555;stroke-width:1"
    return f'<line x1="{x1:.0f}" y1="{y1:.0f}" x2="{x2:.0f}" y2="{y2:.0f}" style="{style}"/>'


def draw_section() -> list[str]:
    """The section through the axis: mirror's film left, clear film right, gas between."""
    left, right = AXIS_X - RING_W / 2, AXIS_X + RING_W / 2
    mirror = bowl_path(left, -SAG_MM * MM * DEEPER)
    clear = bowl_path(right, BULGE_MM * MM * DEEPER)
    parts = [
        text(AXIS_X, 40, "section (bowls three times as deep)", "middle", 17),
        f'<path d="{mirror} L {right:.1f} {AXIS_Y + RADIUS:.1f} Q '
        f"{right + 2 * BULGE_MM * MM * DEEPER:.1f} {AXIS_Y:.1f} {right:.1f} {AXIS_Y - RADIUS:.1f} Z"
        '" style="fill:#e4eefb;stroke:none"/>',
        f'<path d="{mirror}" style="fill:none;stroke:#333;stroke-width:4"/>',
        f'<path d="{clear}" style="fill:none;stroke:#4a86c5;stroke-width:1.5"/>',
    ]
    for side in (-1, 1):
        y = AXIS_Y + side * (RADIUS + RING_H / 2) - RING_H / 2
        for number in (-1, 0, 1):
            x = AXIS_X + number * (RING_W + 3) - RING_W / 2
            fill = "#c9c9c9" if number else "#a0a0a0"
            parts.append(
                f'<rect x="{x:.1f}" y="{y:.1f}" width="{RING_W}" height="{RING_H}" '
                f'style="fill:{fill};stroke:#333"/>'
            )
    mirror_x = left - SAG_MM * MM * DEEPER
    clear_x = right + BULGE_MM * MM * DEEPER
    parts += [
        # laser behind, camera and screen in front
        f'<rect x="40" y="{AXIS_Y - 14:.0f}" width="70" height="28" fill="#fff" stroke="#333"/>',
        text(75, AXIS_Y + 5, "laser", "middle"),
        line(
            110, AXIS_Y, mirror_x - 3, AXIS_Y, "stroke:#c00;stroke-width:1.5;stroke-dasharray:5 3"
        ),
        line(clear_x + 60, AXIS_Y - 150, mirror_x + 6, AXIS_Y, "stroke:#888;stroke-dasharray:2 4"),
        line(clear_x + 60, AXIS_Y + 150, mirror_x + 6, AXIS_Y, "stroke:#888;stroke-dasharray:2 4"),
        text(clear_x + 66, AXIS_Y - 150, "camera"),
        text(clear_x + 66, AXIS_Y + 158, "screen"),
        # labels
        line(mirror_x + 16, AXIS_Y - 70, 120, AXIS_Y - 130),
        text(20, AXIS_Y - 156, "mirror's film:"),
        text(20, AXIS_Y - 138, "PET 50 µm, 100 nm Al"),
        line(clear_x - 12, AXIS_Y + 60, clear_x + 30, AXIS_Y + 84),
        text(clear_x + 34, AXIS_Y + 86, "clear film, PET 10 µm"),
        text(AXIS_X + 12, AXIS_Y + 6, "N2", "middle"),
        text(
            20,
            AXIS_Y + RADIUS + 62,
            _DEPTHS,
        ),
        text(
            20, AXIS_Y + RADIUS + 82, "three concentric rings of aluminium alloy clamp both films"
        ),
    ]
    return parts


def draw_middle_ring() -> list[str]:
    """The middle ring from the front, with its two ports."""
    outer = RADIUS * 0.8
    top = AXIS_Y - outer
    parts = [
        text(FRONT_X, 40, "middle ring, with both ports", "middle", 17),
        f'<circle cx="{FRONT_X}" cy="{AXIS_Y}" r="{outer}" style="fill:#a0a0a0;stroke:#333"/>',
        f'<circle cx="{FRONT_X}" cy="{AXIS_Y}" r="{outer - 18}" style="fill:#fff;stroke:#333"/>',
        line(FRONT_X - outer + 18, AXIS_Y, FRONT_X + outer - 18, AXIS_Y),
        text(FRONT_X, AXIS_Y - 8, "optical diameter 1000 mm", "middle"),
    ]
    for x, words in (
        (FRONT_X - 70, ("nitrogen, by", "a diaphragm pump")),
        (FRONT_X + 70, ("gauge",)),
    ):
        parts.append(line(x, top + 24, x, top - 40, "stroke:#333;stroke-width:6"))
        parts.append(line(x, top + 24, x, top - 40, "stroke:#fff;stroke-width:3"))
        for row, word in enumerate(words):
            parts.append(text(x, top - 66 + 18 * row, word, "middle"))
    parts += [
        text(FRONT_X, AXIS_Y + 30, "two ports, flexible silicone tubes;", "middle"),
        text(FRONT_X, AXIS_Y + 50, "a third for vent and relief valve", "middle"),
        text(FRONT_X, AXIS_Y + 70, "is ours, not the paper's", "middle"),
        text(FRONT_X, AXIS_Y + RADIUS + 62, "not given: sections of the rings, screws,", "middle"),
        text(FRONT_X, AXIS_Y + RADIUS + 82, "places and bores of the ports", "middle"),
    ]
    return parts


def draw_ring() -> str:
    """The drawing as SVG."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        'font-family="sans-serif" role="img" aria-label="rings, films and ports of the mirror">'
    )
    ground = f'<rect width="{WIDTH}" height="{HEIGHT}" style="fill:#fff"/>'
    return "\n".join([head, ground, *draw_section(), *draw_middle_ring(), "</svg>", ""])


if __name__ == "__main__":
    TARGET.write_text(draw_ring(), encoding="utf-8")
    print(TARGET)
