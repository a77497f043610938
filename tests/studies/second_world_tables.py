"""Tables and page of the answers of random benches of the second optical world."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

PARTS = {"sag": slice(0, 1), "Z4..Z11": slice(1, 9), "map at 10 points": slice(9, None)}
TWO_SIDED_95 = 1.96
FAR = 3.0  # sigmas beyond which an `ok` is wrong
MEDIAN_OF_NORMAL = 0.6745
NORMAL_FAR = 0.0027  # share of normal numbers beyond three sigma
WORST = 12
USABLE = ("ok", "degraded")

# What a statement blames, and which planted causes make it true. The first pattern that matches a
# statement decides; a statement that matches none names no cause.
BLAMED: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("", r"cause unknown", ()),
    ("stale", r"stale|shows [xy]_|same picture", ("stale frame",)),
    (
        "orientation",
        r"rotated|mirrored|upside|(columns and rows|x and y) exchanged",
        ("frames rotated", "frames mirrored", "frames axes exchanged", "screen's axes exchanged"),
    ),
    ("byte order", r"byte order|bytes", ("bytes exchanged",)),
    ("packing", r"pack", ("12 bits packed",)),
    ("folding lens", r"fold", ("stated lens folds",)),
    (
        "previous picture",
        r"previous pattern|previous picture|panel's response|response time|LCD",
        ("previous picture",),
    ),
    (
        "second reflection",
        r"second reflection|ghost|second surface|reflection",
        ("second reflection",),
    ),
    (
        "saturated or clipped",
        r"saturat|expos|clip|extreme level",
        ("overexposed", "video range", "clipped at black"),
    ),
    (
        "camera's response",
        r"response of the camera|camera's response|not linear|non-linear",
        ("camera's response has a gamma", "gamma above 1"),
    ),
    ("blur", r"blur|focus", ("blur",)),
    (
        "panel's light",
        r"falls off|fall-off|viewing angle",
        ("panel falls off", "contrast falls off", "gamma by angle"),
    ),
    ("wrinkles", r"wrinkl", ("wrinkles",)),
    ("film moved", r"film (has )?moved|film moves|motion of the film", ("film moves", "no laser")),
    ("knocked", r"knock|camera moved|screen moved", ("camera moves",)),
    ("flicker", r"flicker|light of the others", ("flicker", "ambient light")),
    (
        "geometry",
        r"rim|geometry|camera's pose|uncalibrated|calibrate",
        ("geometry by hand", "frames", "screen's axes", "stated lens folds", "wrinkles"),
    ),
)


def statements(one: dict[str, Any]) -> list[str]:
    """Reasons of a set, and its flagged frames."""
    return [part for part in [*one["reason"].split("; "), *one["flagged"]] if part]


def blamed(statement: str) -> tuple[str, tuple[str, ...]]:
    """What a statement blames, and the planted causes that make it true; empty if it names none."""
    for name, pattern, causes in BLAMED:
        if re.search(pattern, statement):
            return name, causes
    return "", ()


def is_true(causes: Iterable[str], planted: Iterable[str]) -> bool:
    """Whether one of the causes was planted."""
    return any(there.startswith(cause) for cause in causes for there in planted)


def held(given: list[dict[str, Any]], of: str, part: slice) -> tuple[float, float, int]:
    """Share of 95 % intervals that contain the truth, bar over scatter (1 is sharp), intervals."""
    pairs = []
    for one in given:
        source = one if of == "change" else one["sets"][0]
        error, sigma = (
            ("change_error_um", "change_sigma_um") if of == "change" else ("error_um", "sigma_um")
        )
        if error in source and all(each["verdict"] in USABLE for each in one["sets"]):
            pairs.append((source[error][part], source[sigma][part]))
    if not pairs:
        return float("nan"), float("nan"), 0
    errors, sigmas = np.array(pairs).transpose(1, 0, 2)
    ratio = np.abs(errors) / np.maximum(sigmas, 1e-12)
    return (
        float(np.mean(ratio < TWO_SIDED_95)),
        MEDIAN_OF_NORMAL / max(float(np.median(ratio)), 1e-12),
        errors.size,
    )


def sigmas_off(one: dict[str, Any]) -> float:
    """Largest error of a set over its sigma; 0 without a figure."""
    if "error_um" not in one:
        return 0.0
    return float(np.max(np.abs(one["error_um"]) / np.maximum(one["sigma_um"], 1e-12)))


def wrong_oks(given: list[dict[str, Any]]) -> list[tuple[float, dict[str, Any]]]:
    """Benches whose first set is `ok` with an error beyond three sigma, the worst first."""
    far = [(sigmas_off(one["sets"][0]), one) for one in given if one["sets"][0]["verdict"] == "ok"]
    return sorted(((off, one) for off, one in far if off > FAR), key=lambda pair: -pair[0])


def expected_wrong_oks(given: list[dict[str, Any]]) -> float:
    """Number of such benches if all errors were normal and had exactly the stated covariance."""
    firsts = [one["sets"][0] for one in given]
    return sum(float(one.get("chance_far", 0.0)) for one in firsts if one["verdict"] == "ok")


def share_far(given: list[dict[str, Any]]) -> tuple[float, int]:
    """Share of the numbers of `ok` first sets that are beyond three sigma, and their count."""
    firsts = [one["sets"][0] for one in given]
    ratios = [
        np.abs(one["error_um"]) / np.maximum(one["sigma_um"], 1e-12)
        for one in firsts
        if one["verdict"] == "ok"
    ]
    if not ratios:
        return 0.0, 0
    every = np.concatenate(ratios)
    return float(np.mean(every > FAR)), every.size


def refusals(given: list[dict[str, Any]]) -> list[tuple[bool | None, str, dict[str, Any]]]:
    """First sets without a usable verdict: whether the first cause that they name is true.

    None: no cause is named. The text is the naming statement, else the first one.
    """
    found: list[tuple[bool | None, str, dict[str, Any]]] = []
    for one in given:
        first = one["sets"][0]
        if first["verdict"] in USABLE:
            continue
        texts = statements(first) or [""]
        naming = [text for text in texts if blamed(text)[1]]
        if naming:
            _, causes = blamed(naming[0])
            found.append((is_true(causes, one["planted"]), naming[0], one))
        else:
            found.append((None, texts[0], one))
    return found


def named_causes(given: list[dict[str, Any]]) -> Counter[tuple[str, bool]]:
    """How often a cause is named by any statement of a first set, and whether it is true."""
    counts: Counter[tuple[str, bool]] = Counter()
    for one in given:
        for text in statements(one["sets"][0]):
            name, causes = blamed(text)
            counts[name or "(no cause named)", is_true(causes, one["planted"])] += 1
    return counts


def name_geometry(fine: bool) -> str:
    """What the stated sigmas of a bench are."""
    return "sigmas of a hundredth" if fine else "sigmas by hand"


def page(
    by_resolution: dict[str, list[dict[str, Any]]], again: list[dict[str, Any]] | None = None
) -> str:
    """The page of the answers at each resolution, as Markdown; the first has all tables.

    `again` are answers of some of the first ones' benches, measured with a later program.
    """
    main_name, *others = [name for name, given in by_resolution.items() if given]
    given = by_resolution[main_name]
    parts = [HEAD, _origin_text(main_name, given), _coverage_table(given), _verdict_text(given)]
    parts += ["## By planted cause\n", _cause_table(given), "## Statements\n", STATEMENTS]
    parts += [_statement_table(given), "## Worst cases, by seed\n", WORST_TEXT]
    parts += [_worst_tables(given)]
    if again:
        parts += ["## Some of these benches, measured again\n", _again_text(given, again)]
    for name in others:
        parts += [f"## At another resolution: {name}\n", _origin_text(name, by_resolution[name])]
        parts += [_coverage_table(by_resolution[name]), _verdict_text(by_resolution[name])]
    return "\n".join(parts)


def _origin_text(resolution: str, given: list[dict[str, Any]]) -> str:
    commits = sorted({one["commit"].removesuffix("-dirty") for one in given})
    size = "full size" if resolution == "full" else f"{_with_article(resolution)} of the resolution"
    seconds = sum(one["cpu_s"] for one in given) / len(given)
    return (
        f"{len(given)} benches at {size}, {seconds:.1f} s of a core each, "
        f"seeds {given[0]['seed']} to {given[-1]['seed']}, commit {', '.join(commits)}.\n"
    )


def _again_text(given: list[dict[str, Any]], again: list[dict[str, Any]]) -> str:
    """Both answers of the benches that were measured twice, side by side."""
    seeds = {one["seed"] for one in again}
    before = [one for one in given if one["seed"] in seeds]
    known = {one["seed"] for one in before}
    after = [one for one in again if one["seed"] in known]
    commits = sorted({one["commit"].removesuffix("-dirty") for one in after})
    numbers = sorted(known)
    lines = [
        AGAIN_TEXT,
        f"{len(after)} benches, seeds {numbers[0]} to {numbers[-1]}, commit {', '.join(commits)}.",
        "",
        "| | before | after |",
        "|---|---|---|",
    ]
    for of in ("height", "change"):
        for fine in (False, True):
            for quantity, part in PARTS.items():
                cells = []
                for answers in (before, after):
                    some = [one for one in answers if one["fine"] == fine]
                    share, width, size = held(some, of, part)
                    cells.append(f"{100 * share:.0f} % of {size}, {width:.1f}" if size else "-")
                lines.append(f"| {of}, {name_geometry(fine)}: {quantity} | {' | '.join(cells)} |")
    far = [sum(off > FAR for off, _ in _changes_off(answers)) for answers in (before, after)]
    lines.append(f"| changes with a number beyond 3 sigma | {far[0]} | {far[1]} |")
    false = [
        sum(number for (name, is_right), number in named_causes(answers).items() if not is_right)
        - named_causes(answers)["(no cause named)", False]
        for answers in (before, after)
    ]
    lines.append(f"| statements that name a false cause | {false[0]} | {false[1]} |")
    oks = [sum(one["sets"][0]["verdict"] == "ok" for one in answers) for answers in (before, after)]
    lines.append(f"| first sets that are `ok` | {oks[0]} | {oks[1]} |")
    return "\n".join([*lines, ""])


def _changes_off(given: list[dict[str, Any]]) -> list[tuple[float, dict[str, Any]]]:
    """Largest error of each change of usable sets over its sigma, the worst first."""
    changes = []
    for one in given:
        if "change_error_um" in one and all(each["verdict"] in USABLE for each in one["sets"]):
            ratio = np.abs(one["change_error_um"]) / np.maximum(one["change_sigma_um"], 1e-12)
            changes.append((float(ratio.max()), one))
    return sorted(changes, key=lambda pair: -pair[0])


def _with_article(resolution: str) -> str:
    return f"an {resolution}" if resolution == "eighth" else f"a {resolution}"


def _coverage_table(given: list[dict[str, Any]]) -> str:
    lines = [
        f"| {len(given)} benches | sag | Z4..Z11 | map at 10 points |",
        "|---|---|---|---|",
    ]
    for of in ("height", "change"):
        for fine in (False, True):
            some = [one for one in given if one["fine"] == fine]
            cells = []
            for part in PARTS.values():
                share, width, size = held(some, of, part)
                cells.append(f"{100 * share:.0f} % of {size}, {width:.1f}" if size else "-")
            name = "height" if of == "height" else "change between the sets"
            lines.append(f"| {name}, {name_geometry(fine)} | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def _verdict_text(given: list[dict[str, Any]]) -> str:
    verdicts = Counter(one["sets"][0]["verdict"] for one in given)
    counts = ", ".join(f"{number} `{name}`" for name, number in verdicts.most_common())
    wrong, refused = wrong_oks(given), refusals(given)
    true = sum(is_right is True for is_right, _, _ in refused)
    unnamed = sum(is_right is None for is_right, _, _ in refused)
    coarse = [one for one in given if not one["fine"]]
    coarse_ok = sum(one["sets"][0]["verdict"] == "ok" for one in coarse)
    share = 100 * len(wrong) / max(len(given), 1)
    causes = f"{100 * true / len(refused):.0f} %" if refused else "none refused"
    causes += f"; {unnamed} name no cause" if unnamed else ""
    by_hand = f"Of the {len(coarse)} benches with sigmas by hand {coarse_ok} are `ok`."
    expected = expected_wrong_oks(given)
    by_chance = f"{expected:.1f}, {100 * expected / max(len(given), 1):.1f} %"
    wrong_row = (
        f"| benches, `ok`, with one of their numbers beyond 3 sigma | {len(wrong)}, {share:.1f} % "
        f"| {by_chance} | |"
    )
    refusal = "refusals whose first named cause is planted"
    refused_row = f"| {refusal} | {true} of {len(refused)}, {causes} | | 95 % |"
    lines = [f"First sets: {counts}. {by_hand}", "", CHANCE_TEXT, ""]
    lines += ["| | reached | by chance | goal |", "|---|---|---|---|"]
    far, numbers = share_far(given)
    far_row = (
        f"| numbers of `ok` sets beyond 3 sigma, of {numbers} "
        f"| {100 * far:.2f} % | {100 * NORMAL_FAR:.2f} % | 0.5 % |"
    )
    lines += [far_row, wrong_row, refused_row, ""]
    return "\n".join(lines)


def _cause_table(given: list[dict[str, Any]]) -> str:
    lines = [
        "| planted | benches | height % | change % | `ok` | numbers of `ok` beyond 3 sigma, % "
        "| no figure |",
        "|---|---|---|---|---|---|---|",
    ]
    every = sorted({cause for one in given for cause in one["planted"]})
    for cause in ["(all)", *every]:
        some = [one for one in given if cause == "(all)" or cause in one["planted"]]
        shares = [100 * held(some, of, slice(None))[0] for of in ("height", "change")]
        cells = ["-" if np.isnan(share) else f"{share:.0f}" for share in shares]
        oks = sum(one["sets"][0]["verdict"] == "ok" for one in some)
        none = sum(one["sets"][0]["verdict"] not in USABLE for one in some)
        name = cause.replace("um", "µm").replace("urad", "µrad")
        far, numbers = share_far(some)
        far_cell = f"{100 * far:.1f}" if numbers else "-"
        row = [name, len(some), *cells, oks, far_cell, none]
        lines.append(f"| {' | '.join(str(cell) for cell in row)} |")
    return "\n".join([*lines, ""])


def _statement_table(given: list[dict[str, Any]]) -> str:
    counts = named_causes(given)
    lines = ["| blamed | true | false |", "|---|---|---|"]
    for name in sorted(
        {name for name, _ in counts}, key=lambda n: -counts[n, True] - counts[n, False]
    ):
        right, wrong = counts[name, True], counts[name, False]
        cells = f"{right + wrong} in all | " if name.startswith("(") else f"{right} | {wrong}"
        lines.append(f"| {name} | {cells} |")
    return "\n".join([*lines, ""])


def _worst_tables(given: list[dict[str, Any]]) -> str:
    lines = ["| seed | off by | planted | stated |", "|---|---|---|---|"]
    for off, one in wrong_oks(given)[:WORST]:
        lines.append(f"| {one['seed']} | {off:.1f} sigma | {_planted(one)} | `ok` |")
    degraded = [one for one in given if one["sets"][0]["verdict"] == "degraded"]
    ranked = sorted(degraded, key=lambda one: -sigmas_off(one["sets"][0]))
    for one in [each for each in ranked if sigmas_off(each["sets"][0]) > FAR][:WORST]:
        off, stated = sigmas_off(one["sets"][0]), _cell(one["sets"][0]["reason"])
        lines.append(f"| {one['seed']} | {off:.1f} sigma | {_planted(one)} | degraded: {stated} |")
    for is_right, text, one in refusals(given):
        if is_right is not True:
            verdict = one["sets"][0]["verdict"]
            lines.append(f"| {one['seed']} | - | {_planted(one)} | {verdict}: {_cell(text)} |")
    lines += ["", "Changes:", "", "| seed | off by | planted | verdicts |", "|---|---|---|---|"]
    for off, one in _changes_off(given)[:WORST]:
        if off > FAR:
            verdicts = ", ".join(each["verdict"] for each in one["sets"])
            lines.append(f"| {one['seed']} | {off:.1f} sigma | {_planted(one)} | {verdicts} |")
    return "\n".join([*lines, ""])


def _planted(one: dict[str, Any]) -> str:
    sizes = [
        name if size == 1.0 else f"{name.removesuffix(', share')} {size:.2g}"
        for name, size in one["planted"].items()
    ]
    return _cell("; ".join(sizes).replace(" um ", " µm ").replace("urad", "µrad"))


def _cell(text: str) -> str:
    return text.replace("|", "\\|")[:160]


HEAD = """# Measured: benches of a second world

Generated by `python -m benchmarks.metrology.second_world`. The frames come from a renderer that
shares no code with the metrology or with the simulator (`tests/worlds/second_optics`): an
orthotropic film of finite strains on an uneven ring, its own ray tracer, lens, bent screen, glass,
air, panel and camera. Every input of the geometry is off at random; half of the benches have the
sigmas of a hand measurement, half those of a hundredth. About three effects come on top; the table
by cause lists them. Two sets a bench, 120 s apart; in between, camera and screen move by what the
bar of a change allows for (3 µm and 3 µrad, 10 µm along their axes, 1 sigma). With a laser the
truth is the film at the mean of the sinusoids, without one at the mean of all frames, which the bar
covers. `make benches` measures up to 500 of them at a quarter of the resolution, 6 s of a core
each: half an hour on 2 cores. A run can be stopped and continues where it was; the numbers below
state how many were measured. [500 benches at rest](second-world-at-rest.md) have another page.

Tables give the share of the 95 % intervals that contain the truth (goal 93 to 97 %), and bar over
scatter (1 is sharp), of sets that are `ok` or `degraded`.
"""

STATEMENTS = """Each reason and each flagged frame of a first set names a cause or names none.
A statement is true if a cause that explains it was planted.
"""

CHANCE_TEXT = """A bench has 19 numbers. By chance: what normal errors with exactly the stated
covariance would give."""

AGAIN_TEXT = """Mended since the first answers:

- Blur carries light across the edges of Gray bits. From 1.1 px on it looked like a second image of
  0.5 to 3 % of the light; these were all of the false second reflections.
- The bar of a change contained the worst motion of any one body that explains the tilt of the ring,
  and not two bodies that tilt it in opposite directions. On the bench of seed 523 a camera had
  turned by 12 µrad (4 sigma of what was drawn) and two shifts had hidden its tilt: Z7 was off by
  3.7 sigma. The rows of changes below have the bar of all causes by their weight; the program
  states the wider of both, because that one misses a single camera that turned by 20 to 50 µrad.
- Drifts of the phases counted as motions of the bench from 1 sigma of their scatter on, and from 2
  sigma on now.
- Overexposed pictures of which 2 % of the bins were left were named rotated by 180 degrees (bench
  716); they are named saturated.
"""

WORST_TEXT = """`tests.studies.second_benches.bench_answer(seed)` repeats a bench. First sets: `ok`
beyond 3 sigma, `degraded` beyond 3 sigma, refusals whose cause was not planted.
"""
