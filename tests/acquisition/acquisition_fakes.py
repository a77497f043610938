"""A screen, a camera, a laser and a reconstructor scripted by a test, on a virtual clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from firmware_iface.optical_roles import Frame, Pattern, Pixels
from firmware_iface.roles import LinkError
from membrane_ctrl.acquisition.cycle_plan import CyclePlan
from membrane_ctrl.model.shape_estimate import ShapeEstimate, Verdict
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

HEIGHT_PX, WIDTH_PX = 4, 6
FRINGES = [Pattern("sin", axis, k) for axis in "xy" for k in range(4)]
FULL = [
    *FRINGES,
    *(Pattern("gray", axis, k) for axis in "xy" for k in range(1, 5)),
    Pattern("white"),
    Pattern("black"),
]
PLAN = CyclePlan(FULL, FRINGES, frame_interval_s=0.1)


class VirtualClock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def now(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s


@dataclass
class FakeScreen:
    shown: list[str] = field(default_factory=list)
    broken: bool = False

    def show(self, pattern: Pattern) -> None:
        if self.broken:
            raise LinkError("screen: no display")
        self.shown.append(pattern.name)

    def close(self) -> None:
        pass


@dataclass
class FakeCamera:
    """Every frame is as bright as its number, and takes `exposure_s`."""

    clock: VirtualClock
    exposure_s: float = 0.02
    broken: bool = False
    own_pixels: NDArray[np.uint8] | None = None  # for a camera that cannot write to a given place
    frames: int = 0

    def grab(self, out: Pixels | None = None) -> Frame:
        if self.broken:
            raise LinkError("camera: no trigger")
        time_s = self.clock.now()
        self.clock.sleep(self.exposure_s)
        pixels = out if self.own_pixels is None else self.own_pixels
        assert pixels is not None
        pixels[...] = self.frames
        self.frames += 1
        return Frame(pixels, time_s)

    def close(self) -> None:
        pass


class FakeLaser:
    def at(self, time_s: float) -> float:
        return 10.0 * time_s


@dataclass
class Call:
    kind: str
    levels: list[int]
    time_s: NDArray[np.float64]
    displacement_um: NDArray[np.float64]


@dataclass
class FakeReconstructor:
    """Returns the given verdicts, then "ok"; takes 0.05 s."""

    clock: VirtualClock
    verdicts: list[tuple[Verdict, str]] = field(default_factory=list)
    calls: list[Call] = field(default_factory=list)
    singular: bool = False
    prepared: int = 0

    def prepare(self) -> None:
        self.prepared += 1
        if self.singular:
            raise np.linalg.LinAlgError("singular matrix")

    def measure_full(
        self,
        frames: Sequence[Pixels],
        time_s: NDArray[np.float64],
        displacement_um: NDArray[np.float64],
    ) -> ShapeEstimate:
        return self._answer("full", frames, time_s, displacement_um)

    def measure_fringes(
        self,
        frames: Sequence[Pixels],
        time_s: NDArray[np.float64],
        displacement_um: NDArray[np.float64],
    ) -> ShapeEstimate:
        return self._answer("fringes", frames, time_s, displacement_um)

    def _answer(
        self,
        kind: Literal["full", "fringes"],
        frames: Sequence[Pixels],
        time_s: NDArray[np.float64],
        displacement_um: NDArray[np.float64],
    ) -> ShapeEstimate:
        self.calls.append(
            Call(kind, [int(frame[0, 0]) for frame in frames], time_s, displacement_um)
        )
        self.clock.sleep(0.05)
        if self.singular:
            raise np.linalg.LinAlgError("singular matrix")
        verdict, reason = self.verdicts.pop(0) if self.verdicts else ("ok", "")
        lost = reason.startswith("tracking lost")
        return estimate(kind, float(np.mean(time_s)), verdict, reason, tracking_lost=lost)


def estimate(
    kind: Literal["full", "fringes"] = "fringes",
    time_s: float = 0.0,
    verdict: Verdict = "ok",
    reason: str = "",
    sag_um: float = 37100.0,
    cycle: int = 0,
    tracking_lost: bool = False,
) -> ShapeEstimate:
    return ShapeEstimate(
        time_s=time_s,
        kind=kind,
        coeffs_um=np.zeros(ZERNIKE_TERMS),
        hencky_um=0.0,
        covariance_um2=np.eye(ZERNIKE_TERMS),
        sag_um=sag_um,
        sag_change_sigma_um=0.01,
        displacement_um=0.0,
        slope_residual_urad=3.1,
        valid_fraction=0.99,
        modulation_median_adu=81.0,
        saturated_fraction=0.0,
        verdict=verdict,
        reason=reason,
        cycle=cycle,
        tracking_lost=tracking_lost,
    )
