"""Phase from equal and unequal steps."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.phase import phase_steps

PHASES = np.linspace(-np.pi, np.pi, 102)[1:-1]  # the end itself may come out on either side


def _frames(shifts: np.ndarray) -> np.ndarray:
    return 100 + 70 * np.cos(PHASES + shifts[:, None])


@pytest.mark.parametrize("steps", [3, 4, 5, 7, 12])
def test_equal_steps(steps: int) -> None:
    z = phase_steps.compute_phasors(
        _frames(phase_steps.equal_shifts(steps)), phase_steps.equal_shifts(steps)
    )
    assert np.angle(z) == pytest.approx(PHASES, abs=1e-12)
    assert np.abs(z) == pytest.approx(70)


def test_four_steps_are_the_papers_equation_1() -> None:
    shifts = phase_steps.equal_shifts(4)
    i1, i2, i3, i4 = frames = _frames(shifts) + np.random.default_rng(1).normal(0, 3, (4, 100))
    assert np.angle(phase_steps.compute_phasors(frames, shifts)) == pytest.approx(
        np.arctan2(i4 - i2, i1 - i3)
    )


def test_unequal_steps_in_any_order() -> None:
    shifts = np.array([4.1, 0.3, 2.2, 1.0, 5.5])
    assert np.angle(phase_steps.compute_phasors(_frames(shifts), shifts)) == pytest.approx(
        PHASES, abs=1e-12
    )


@pytest.mark.parametrize(
    "shifts", [[0.0, 1.0], [0.0, 0.0, np.pi, np.pi], [0.0, 2 * np.pi, 4 * np.pi, 1.0]]
)
def test_steps_that_determine_nothing_are_refused(shifts: list[float]) -> None:
    with pytest.raises(ValueError, match="do not determine a phase"):
        phase_steps.step_weights(shifts)


def test_residual_names_the_disturbed_frame() -> None:
    shifts = phase_steps.equal_shifts(5)
    frames = _frames(shifts)
    assert phase_steps.step_residual(frames, shifts) == pytest.approx(0, abs=1e-11)
    frames[2] += 10
    assert np.argmax(np.abs(phase_steps.step_residual(frames, shifts)).mean(axis=1)) == 2


@pytest.mark.parametrize("shifts", [phase_steps.equal_shifts(4), np.array([0.0, 1.2, 2.9, 4.0])])
def test_predicted_noise_is_the_scatter_seen(shifts: np.ndarray) -> None:
    noise = np.random.default_rng(2).normal(0, 0.5, (len(shifts), 400, 100))
    seen = np.angle(phase_steps.compute_phasors(_frames(shifts)[:, None] + noise, shifts)) - PHASES
    scatter = np.sqrt(np.mean(np.angle(np.exp(1j * seen)) ** 2))
    assert phase_steps.phase_sigma_rad(shifts, 0.5, 70) == pytest.approx(scatter, rel=0.02)
