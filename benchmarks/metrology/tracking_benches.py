"""Accuracy of tracked figures on random benches with disturbances and planted faults.

The number of a bench gives its geometry, film, camera, pattern, disturbances and timing. The
pictures are those of a world that shares no code with the product
(`tests/worlds/crossed_fringes.py`). A figure is silently wrong if it is called ok and off by more
than 5 sigma and 0.1 µm. A bench whose reference `measure` rejects, or whose fringes `track`
refuses, does not count. Results go to a file, line by line: a stopped run continues at the next
bench.

python -m benchmarks.metrology.tracking_benches [--benches N] [--first K]
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import shutil
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.cli import run as command
from tests.studies.tracked_errors import CLEAN, TrackedErrors, compared, rms
from tests.worlds.crossed_fringes import RADIUS_MM, Array, CrossedWorld

ANSWERS = Path("logs/tracking_benches.jsonl")
FAR_SIGMAS, FAR_UM, WIDTHS = 5.0, 0.1, (245, 300, 345, 400)
PIXEL_RAD = 2.3  # of the crossed fringes, in 95 % of the pixels
# Largest sizes of what disturbs, each present in half of the benches; docs/measurements/tracking.md
DISTURBANCES = {
    "drift_um_per_s": 0.01,
    "swing_um": 0.3,
    "shimmer_um": 0.1,
    "brightness": 0.005,
    "ambient_adu": 2.0,
    "bend": 0.04,
    "dim_per_s": 1e-4,
    "dust": 20,
    "air_um": 0.1,
    "sticking": 0.02,
    "drum_nm": 5.0,
}
# What a planted fault must be called; a jump may also be followed, if the figure is right
NAMES = {
    "frozen": "frozen",
    "saturated": "saturated",
    "dark": "dark",
    "exposure": "exposure changed",
    "hand": "covered",
    "jump": "",
    "blank": "no fringes",
    "missing": "",
}
GAINS = {"saturated": 2.5, "dark": 0.1, "blank": math.nan}


@dataclass
class Bench(CrossedWorld):
    """The world with faults at some times; a jump stays."""

    gains: dict[float, float] = field(default_factory=dict)  # by time; NaN is a grey screen
    jump_s: float = math.inf
    jump_um: tuple[float, float, float] = (
        0.0,
        0.0,
        0.0,
    )  # of the sag, and a tilt along x and y at the rim

    def sag_um(self, t: Any) -> Any:
        return super().sag_um(t) + self.jump_um[0] * (t >= self.jump_s)

    def film_mm(self, x: Array, y: Array, t: Any) -> Array:
        tilt_um = (self.jump_um[1] * x + self.jump_um[2] * y) / RADIUS_MM
        return np.asarray(super().film_mm(x, y, t) + 1e-3 * tilt_um * (t >= self.jump_s))

    def crossed(
        self, t: float, shift_x: float = 0.0, shift_y: float = 0.0, gain: float = 1.0
    ) -> NDArray[Any]:
        gain = self.gains.get(t, gain)
        if math.isnan(gain):
            return self.frame(t, lambda s_x, _: np.full_like(s_x, 0.5))
        return super().crossed(t, shift_x, shift_y, gain)


class Run(NamedTuple):
    """When a bench takes frames and steps its pattern, and its faults by frame."""

    times: Array
    step_every_s: float
    first_steps: int
    faults: dict[int, str]


def geometry_of(random: np.random.Generator) -> dict[str, Any]:
    """A bench and a film whose fringes the camera resolves, without caustics on the screen."""
    while True:
        alpha_deg, focal_mm, fill = random.uniform((74.0, 8.0, 0.8), (86.0, 50.0, 0.96))
        setup: dict[str, Any] = {
            "a_mm": random.uniform(1500, 5000),
            "b_mm": random.uniform(1500, 5000),
            "alpha_deg": alpha_deg,
            "sag_mm": random.uniform(20, 60),
            "focal_mm": focal_mm,
            "coma_mm": random.uniform(-0.1, 0.1),
            "astigmatism_mm": tuple(random.uniform(-0.5, 0.5, 2).tolist()),
            "ripple_mm": random.uniform(0, 0.004),
            "ripple_waves": tuple(random.uniform(-7, 7, 2).tolist()),
            "crossed_periods": int(random.choice([16, 24, 32, 40])),
        }
        for width in WIDTHS:
            setup |= {"width": width, "height": round(width * 205 / 245)}
            setup["pixel_um"] = (
                1e3 * RADIUS_MM * 2 * focal_mm / setup["a_mm"] / (fill * setup["height"])
            )
            s_x, s_y, x, y, _ = CrossedWorld(**setup | CLEAN).trace(0.0)
            used = np.hypot(x, y) < 475.0
            side_mm = (
                2
                * max(np.abs(s_x[used]).max(), np.abs(s_y[used]).max())
                * random.uniform(0.8, 1.05)
            )
            turned = np.array(
                [[np.gradient(s, axis=axis)[used] for axis in (0, 1)] for s in (s_x, s_y)]
            )
            area = turned[0, 0] * turned[1, 1] - turned[0, 1] * turned[1, 0]
            least = np.abs(area).min() / np.median(np.abs(area))
            if not 250 < side_mm < 700 or np.ptp(np.sign(area)) or least < 0.03:
                break
            steps = (
                np.quantile(np.abs(turned), 0.95, axis=2).max()
                * 2
                * math.pi
                * setup["crossed_periods"]
                / side_mm
            )
            if steps < PIXEL_RAD:
                return setup | {"side_mm": float(side_mm)}


def bench_of(number: int) -> tuple[Bench, Run]:
    """The bench with a number."""
    random = np.random.default_rng((20, number))
    setup = geometry_of(random)
    off = {name: type(most)(0) for name, most in DISTURBANCES.items()}
    some = {
        name: type(most)(random.uniform(0, most))
        for name, most in DISTURBANCES.items()
        if random.random() < 0.5
    }
    slow = {
        "backlight_hz": random.uniform(1000, 3000),
        "rolling_s": random.uniform(0, 0.02),
        "laser_um": 1.0,
    }
    some |= {name: value for name, value in slow.items() if random.random() < 0.5}
    world = Bench(
        **setup | off | some,
        sticking_s=random.uniform(60, 3600),
        bits=int(random.choice([8, 12, 16])),
        noise_adu=float(np.exp(random.uniform(np.log(0.1), np.log(2)))),
        contrast=random.uniform(0.5, 1),
        seed=number,
    )
    frames, frame_s = (
        int(random.integers(60, 101)),
        float(np.exp(random.uniform(np.log(0.05), np.log(2)))),
    )
    step_s = float(random.choice([random.uniform(5, 30), math.inf]))
    times = np.asarray(0.5 + frame_s * np.arange(frames), float)
    faults = _planted(world, times, random) if random.random() < 0.5 else {}
    return world, Run(times, step_s, int(random.choice([5, 5, 0])), faults)


def _planted(world: Bench, times: Array, random: np.random.Generator) -> dict[int, str]:
    """Faults in frames that do not touch each other; the simulated world gets those that it shows
    itself.
    """
    places = np.sort(random.choice(np.arange(1, times.size // 2 - 1), 5, replace=False)) * 2
    kinds = random.choice([kind for kind in NAMES if kind != "jump"], places.size).tolist()
    faults = dict(zip(places.tolist(), kinds, strict=True))
    for k, kind in faults.items():
        if kind == "exposure":
            world.gains[float(times[k])] = float(random.choice([0.9, 1.1]))
        elif kind in GAINS:
            world.gains[float(times[k])] = GAINS[kind]
    if random.random() < 0.5:
        k = min(max(faults) + 2, times.size - 1)
        most = random.uniform((-1e3, 0), (1e3, 10 * RADIUS_MM))
        deeper_um, tilt_um = most * random.random(2)  # often small
        azimuth = random.uniform(0, 2 * math.pi)
        faults[k] = "jump"
        world.jump_s = float(times[k])
        world.jump_um = (deeper_um, tilt_um * math.cos(azimuth), tilt_um * math.sin(azimuth))
    return faults


def spoil(world: Bench, folder: Path, faults: dict[int, str]) -> None:
    """The faults of files."""
    for k, kind in faults.items():
        path = folder / f"t{k}.png"
        if kind == "missing":
            path.unlink()
        elif kind == "frozen":
            shutil.copy(folder / f"t{k - 1}.png", path)
        elif kind == "hand":
            picture, (_, _, x, y, inside) = np.array(cv2.imread(str(path), -1)), world.trace(0.0)
            grey = np.random.default_rng((k, world.seed)).uniform(0.05, 0.8)
            picture[inside & (x > 0) & (y > 0)] = grey * (2**world.bits - 1)
            cv2.imwrite(str(path), picture)


def answer(number: int) -> dict[str, Any]:
    """What a bench gave."""
    world, plan = bench_of(number)
    about = {
        "number": number,
        "faults": {str(k): kind for k, kind in plan.faults.items()},
        "jump_um": world.jump_um,
    }
    output = io.StringIO()
    with (
        tempfile.TemporaryDirectory() as name,
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(output),
    ):
        folder = Path(name)
        world.write_reference(folder / "full")
        if command(["measure", str(folder / "full"), "--no-pictures"]):
            return about | {"counts": "reference rejected", "said": output.getvalue()}
        world.write_track(
            folder / "track", plan.times, plan.step_every_s, first_steps=plan.first_steps
        )
        spoil(world, folder / "track", plan.faults)
        if command(["track", str(folder / "track"), "--no-pictures"]) not in (0, 3):
            return about | {"counts": "fringes refused", "said": output.getvalue()}
        return about | {"counts": "yes"} | judged(compared(world, folder), plan)


def judged(found: TrackedErrors, plan: Run) -> dict[str, Any]:
    """Shares, errors over sigmas, and what is wrong."""
    errors = np.column_stack([found.sag_um, found.terms_um])
    ratio = errors / np.column_stack([found.sag_change_sigma_um, found.steady_terms_sigma_um])
    far = np.any((np.abs(ratio) > FAR_SIGMAS) & (np.abs(errors) > FAR_UM), axis=1)
    frames = np.flatnonzero(found.given)
    good = np.array([found.verdicts[k] == "ok" for k in frames], bool)
    jumped = min([k for k, kind in plan.faults.items() if kind == "jump"], default=plan.times.size)
    sound = [
        k for k in range(jumped) if k not in plan.faults and plan.faults.get(k - 1) != "exposure"
    ]
    output = [
        f"{verdict} {reason}" for verdict, reason in zip(found.verdicts, found.reasons, strict=True)
    ]
    about: dict[str, Any] = {
        "frames": len(output),
        "verdicts": dict(Counter(found.verdicts)),
        "silent": frames[good & far].tolist(),
        "false": dict(Counter(output[k].split(":")[0] for k in sound if found.verdicts[k] != "ok")),
        "planted": [
            {
                "frame": k,
                "fault": kind,
                "said": output[k],
                "right": k not in frames[far],
                "named": found.verdicts[k] != "ok" and NAMES[kind] in output[k],
            }
            for k, kind in plan.faults.items()
        ],
    }
    return (
        about
        if not good.any()
        else about
        | {
            "sag": rms(ratio[good, 0]),
            "terms": rms(ratio[good, 1:]),
            "largest": float(np.abs(ratio[good]).max()),
            "sag_um": rms(errors[good, 0]),
            "terms_um": rms(errors[good, 1:]),
            "worst": int(np.argmax(np.abs(ratio[good]).max(axis=0))) + 1,
        }
    )


def _report(one: dict[str, Any]) -> str:
    if "sag" not in one:
        return (
            f"{one['number']:4d} {one['counts']} {one.get('verdicts', '')} "
            f"{one.get('said', '')[-200:].strip()}"
        )
    missed = [
        f"{f['fault']}: {f['said'][:40]}" for f in one["planted"] if not (f["named"] and f["right"])
    ]
    sag, terms = (
        f"{name} {one[name]:.2f} ({one[name + '_um']:.4f} µm)" for name in ("sag", "terms")
    )
    wrong = f"silently wrong {len(one['silent'])}, not ok {one['false']}, missed {missed}"
    return (
        f"{one['number']:4d} {one['verdicts']} {sag}, {terms}, {one['largest']:.1f} at "
        f"Z{one['worst']}, {wrong}"
    )


def summary(given: list[dict[str, Any]]) -> list[str]:
    """Over the benches, as lines."""
    counts, used = Counter(one["counts"] for one in given), [one for one in given if "sag" in one]
    lines = [f"benches: {dict(counts)}, {len(used)} with frames that are ok"]
    for name in ("sag", "terms", "largest"):
        values = np.array([one[name] for one in used])
        quantiles = ", ".join(
            f"{value:.2f}" for value in np.quantile(values, (0, 0.1, 0.5, 0.9, 1))
        )
        worst = [used[k]["number"] for k in np.argsort(-values)[:5]]
        lines.append(
            f"error / sigma, {name}: {quantiles} (least, 10, 50, 90 %, most); worst benches {worst}"
        )
    silent = {one["number"]: len(one["silent"]) for one in used if one["silent"]}
    false: Counter[str] = sum((Counter(one["false"]) for one in given if "false" in one), Counter())
    lines.append(
        f"silently wrong: {sum(silent.values())} of {sum(one['frames'] for one in used)} "
        f"frames, {silent}"
    )
    lines.append(f"sound frames that were not ok: {dict(false.most_common())}")
    planted = [fault for one in given for fault in one.get("planted", ())]
    for kind in NAMES:
        named, right = (
            [fault[key] for fault in planted if fault["fault"] == kind]
            for key in ("named", "right")
        )
        lines.append(
            f"{kind}: {len(named)} planted, {sum(named)} named, {right.count(False)} with a "
            "wrong figure"
        )
    return lines


def main() -> None:
    """Run the benches that the file lacks; print each and the summary."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--benches", type=int, default=60)
    options.add_argument("--first", type=int, default=0)
    options.add_argument("--answers", type=Path, default=ANSWERS)
    chosen = options.parse_args()
    lines = (
        chosen.answers.read_text(encoding="utf-8").splitlines() if chosen.answers.exists() else []
    )
    known = {one["number"]: one for one in map(json.loads, lines)}
    wanted = range(chosen.first, chosen.first + chosen.benches)
    with chosen.answers.open("a", encoding="utf-8", buffering=1) as file:
        for number in wanted:
            if number not in known:
                known[number] = answer(number)
                file.write(json.dumps(known[number]) + "\n")
            print(_report(known[number]), flush=True)
    print("\n".join(summary([known[number] for number in wanted])))


if __name__ == "__main__":
    main()
