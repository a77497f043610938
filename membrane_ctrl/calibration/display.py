"""The command `calibrate-display`: settling and response of the screen."""

import json

import numpy as np

from firmware_iface.display_response import DisplayResponse
from firmware_iface.display_settling import Settling
from firmware_iface.roles import LinkError
from membrane_ctrl.acquisition import display_test, exposures, optical_bench, waiting_clock
from membrane_ctrl.config.schema import Config, PatternConfig
from membrane_ctrl.metrology.phase.screen_scale import mm_per_rad
from membrane_ctrl.model import errors
from membrane_ctrl.model.clock import RunClock

_PHASES = 720  # per period, to include the worst one


def calibrate_display(config: Config, source: str, as_json: bool) -> int:
    """Open camera and screen, measure settling and response, and report the resulting error.

    Call from the main thread only (because of the screen).

    Parameters
    ----------
    config : Config
        With `devices.camera` and `devices.screen`.
    source : str
        Its file, for messages.
    as_json : bool
        Print the report as JSON instead of lines for people.

    Returns
    -------
    int
        The exit code of the command.

    Raises
    ------
    InputError
        Camera or screen is not configured.
    DeviceError
        One of them fails, or the camera cannot see the screen.
    """
    if config.devices is None or config.devices.camera is None or config.devices.screen is None:
        raise errors.InputError(
            f"{source}: devices.camera and devices.screen are both needed to measure the screen"
        )
    section = config.devices.screen
    clock = waiting_clock.WaitingClock(RunClock.start())
    try:
        bench = optical_bench.configured_bench(config, clock)
        try:
            settling, response = measure_display(bench, clock, section.width_px, section.height_px)
        finally:
            bench.close()
    except LinkError as error:
        raise errors.DeviceError(f"{source}: {error}") from None
    except ValueError as error:
        raise errors.DeviceError(f"{source}: screen: {error}") from None
    report = display_report(settling, response, config.optics.pattern)
    print(json.dumps(report) if as_json else "\n".join(format_display_report(report)))
    return int(errors.Exit.DONE)


def measure_display(
    bench: optical_bench.OpticalBench, clock: exposures.CycleClock, width_px: int, height_px: int
) -> tuple[Settling, DisplayResponse]:
    """Open the bench and measure its screen.

    Parameters
    ----------
    bench : OpticalBench
        Camera and screen, closed.
    clock : CycleClock
        Of the exposures.
    width_px, height_px : int
        Of the screen.

    Returns
    -------
    tuple[Settling, DisplayResponse]
        Its settling, and its response to grey levels.

    Raises
    ------
    LinkError
        A device fails.
    ValueError
        The camera cannot see the screen.
    """
    bench.camera.open()
    bench.screen.open()
    test = display_test.DisplayTest(bench.screen, bench.camera, clock, width_px, height_px)
    return test.measure_settling(), test.measure_response()


def display_report(
    settling: Settling, response: DisplayResponse, pattern: PatternConfig
) -> dict[str, object]:
    """The findings as the command prints them in JSON.

    Parameters
    ----------
    settling : Settling
        Measured times, s; those that could not be measured are NaN.
    response : DisplayResponse
        Measured light of the grey levels.
    pattern : PatternConfig
        The fringes for which the error is computed.

    Returns
    -------
    dict
        Schema `membrane-calibrate-display/1`: times in ms (None if not measured), gamma, and the
        RMS error of a screen coordinate in µm, with levels as sent and corrected.
    """
    bare, corrected = (fringe_error_mm(response, pattern, linear) for linear in (False, True))
    return {
        "schema": "membrane-calibrate-display/1",
        "settle_ms": 1e3 * settling.settle_s,
        "latency_ms": 1e3 * settling.latency_s if np.isfinite(settling.latency_s) else None,
        "time_constant_ms": 1e3 * settling.tau_s if np.isfinite(settling.tau_s) else None,
        "gamma": response.gamma,
        "fringe_error_um": {"as_sent": 1e3 * bare, "corrected": 1e3 * corrected},
    }


def format_display_report(report: dict[str, object]) -> list[str]:
    """Format the report for people, with the lines for the configuration."""
    error = report["fringe_error_um"]
    assert isinstance(error, dict)
    return [
        f"settles in {report['settle_ms']:.0f} ms, gamma {report['gamma']:.2f}",
        f"fringe error on the screen: {error['as_sent']:.1f} µm RMS as sent, "
        f"{error['corrected']:.1f} µm corrected, from the rounding of its levels",
        "for the configuration (otherwise every start measures both):",
        "[devices.screen]",
        f"settle_ms = {report['settle_ms']:.0f}",
        "linearise = true",
    ]


def fringe_error_mm(response: DisplayResponse, pattern: PatternConfig, corrected: bool) -> float:
    """RMS error of a screen coordinate from this display's sinusoids, whose harmonics appear as
    phase.

    Parameters
    ----------
    response : DisplayResponse
        Light of the display's levels.
    pattern : PatternConfig
        The pattern, with its period and number of steps.
    corrected : bool
        Whether the levels are chosen by the response, or are proportional to the wanted light.
    """
    # The light that the steps should have at phases of a period.
    phase = 2 * np.pi * np.arange(_PHASES) / _PHASES
    shifts = 2 * np.pi * np.arange(pattern.steps) / pattern.steps
    wanted = (1 + np.cos(phase + shifts[:, None])) / 2

    # The light that they have.
    if corrected:
        levels = response.find_levels(wanted)
    else:
        levels = np.rint(255 * wanted)
    light = np.interp(levels, response.levels, response.light)

    # The phase that the N-step formula gives, less the true one, within half a turn. Harmonics of
    # the light up to order N - 2 cancel in it; a gamma makes those beyond.
    sine = -np.sin(shifts) @ light
    cosine = np.cos(shifts) @ light
    seen = np.arctan2(sine, cosine)
    error = np.angle(np.exp(1j * (seen - phase)))
    return float(mm_per_rad(pattern) * np.std(error))
