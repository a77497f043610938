"""Sets of several fringe periods, rendered by the twin's ray tracer: orders, noise, bad frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from membrane_ctrl.config.optics import CameraConfig, GeometryConfig, OpticsConfig
from membrane_ctrl.metrology.figure.bin_figure import bin_figure
from membrane_ctrl.metrology.frame_checks.checked_set import Checked, RejectedSetError
from membrane_ctrl.metrology.frame_checks.multi_frequency import check_frequencies
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.pattern_levels import Light, pattern_sequence

FILM = typical_film(37.1, 500.0, 4)
X, Y = np.meshgrid(*[np.linspace(-330, 330, 21)] * 2)


@dataclass(frozen=True)
class Case:
    steps: int = 4
    coarser_mm: tuple[float, ...] = (55.3, 61.7)
    gamma: float = 1.0

    def optics(self) -> OpticsConfig:
        geometry = GeometryConfig(
            a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9, reference_displacement_um=0.0
        )
        camera = CameraConfig(width_px=204, height_px=171, pixel_um=41.4)
        optics = OpticsConfig(geometry=geometry, camera=camera)
        return optics.model_copy(
            update={"pattern": optics.pattern.model_copy(update={"steps": self.steps})}
        )

    def stack(
        self, gains: dict[str, float] | None = None, swap: tuple[str, str] | None = None
    ) -> FrameStack:
        """The set's frames; `gains` are exposures of single frames, `swap` exchanges two."""
        renderer = OpticsRenderer(self.optics(), FILM, Light(gamma=self.gamma), seed=2)
        shown = pattern_sequence("frequencies", self.optics().pattern, coarser_mm=self.coarser_mm)
        pictures = {
            p.name: renderer.render_picture(p, 0.0, gain=(gains or {}).get(p.name, 1.0))
            for p in shown
        }
        if swap is not None:
            a, b = swap
            pictures[a], pictures[b] = pictures[b], pictures[a]
        return FrameStack(
            np.stack([pictures[p.name] for p in shown]), tuple(shown), np.zeros(len(shown)), {}
        )


def error_um(checked: Checked, case: Case) -> float:
    surface = bin_figure(case.optics(), checked).fit.surface
    return 1e3 * float(np.std(surface.height(X, Y) - FILM.height_mm(X, Y)))


def blamed(checked: Checked, stack: FrameStack) -> list[str]:
    return [stack.patterns[flag.frame].name for flag in checked.flags]


@pytest.mark.parametrize(
    "case",
    [
        Case(),
        Case(coarser_mm=(398.56,)),  # one period on the screen
        pytest.param(Case(coarser_mm=(1000.0, 131.7, 57.1), steps=5), marks=pytest.mark.campaign),
        pytest.param(Case(coarser_mm=(59.3,), steps=3), marks=pytest.mark.campaign),
        pytest.param(Case(gamma=2.0), marks=pytest.mark.campaign),
    ],
    ids=["beats", "one period", "four periods", "three steps", "gamma"],
)
def test_periods_of_any_ratio_give_the_figure(case: Case) -> None:
    stack = case.stack()
    checked = check_frequencies(stack, case.optics())
    assert checked.flags == ()
    assert error_um(checked, case) < (0.05 if case.gamma == 1 else 0.5)


@pytest.mark.parametrize(
    ("case", "name"),
    [
        (Case(), "x_sin_0_of_55.3mm"),
        (Case(steps=5), "x_sin_0"),
        pytest.param(Case(), "y_sin_0", marks=pytest.mark.campaign),
        pytest.param(Case(steps=5), "y_sin_0_of_61.7mm", marks=pytest.mark.campaign),
    ],
)
def test_a_first_frame_that_is_too_dark_is_reported(case: Case, name: str) -> None:
    """A display that is still warming up: a tenth of the light is missing."""
    stack = case.stack({name: 0.9})
    checked = check_frequencies(stack, case.optics())
    assert blamed(checked, stack) == [name]
    assert error_um(checked, case) < 0.1


def test_both_first_frames_of_an_axis_are_reported() -> None:
    case, names = Case(steps=5), ["x_sin_0", "x_sin_0_of_55.3mm"]
    stack = case.stack(dict.fromkeys(names, 0.9))
    assert blamed(check_frequencies(stack, case.optics()), stack) == names


def test_frames_in_the_wrong_place_are_no_figure() -> None:
    """Two frames of a coarser period for each other reverse its phase:
    nothing agrees on a place.
    """
    case = Case(coarser_mm=(61.7,))
    with pytest.raises(RejectedSetError, match="the phases of the x periods do not agree"):
        check_frequencies(
            case.stack(swap=("x_sin_1_of_61.7mm", "x_sin_3_of_61.7mm")), case.optics()
        )


def test_a_frame_that_cannot_be_read_is_left_out() -> None:
    case = Case()
    stack = case.stack()
    lost = [pattern.name for pattern in stack.patterns].index("y_sin_2_of_55.3mm")
    stack = replace(stack, unusable={lost: "wrong size"})
    checked = check_frequencies(stack, case.optics())
    assert [(flag.frame, flag.reason) for flag in checked.flags] == [(lost, "wrong size")]
    assert error_um(checked, case) < 0.05
