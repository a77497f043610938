"""Step 5: focus, screen, geometry, first figure."""

import contextlib
import math
from collections.abc import Iterator

import numpy as np

from membrane_ctrl.commissioning.guide import thresholds
from membrane_ctrl.commissioning.guide.bench_access import HandAct, HandMotion
from membrane_ctrl.commissioning.guide.dialogue import Choice
from membrane_ctrl.commissioning.guide.inflation_stages import (
    hold_depth,
    read_sound_news,
    without_camera,
)
from membrane_ctrl.commissioning.guide.rim_edge import measure_rim_edge_px
from membrane_ctrl.commissioning.guide.session_state import (
    CONFIGURATION,
    SessionState,
    TomlTable,
    read_tables,
)
from membrane_ctrl.commissioning.guide.shown_program import OWN_PROGRAM, run_shown
from membrane_ctrl.commissioning.guide.stage import (
    StageContext,
    StageFailedError,
)
from membrane_ctrl.commissioning.guide.threshold import Threshold
from membrane_ctrl.config import sight
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.sessions.live_hold import HoldError

_BY_HAND, _PHOTOGRAPHS = "nothing", "board"
_AT_HAND = (
    Choice(name=_BY_HAND, meaning="the lens' data sheet and a tape measure"),
    Choice(
        name=_PHOTOGRAPHS, meaning="photographs of a board by this camera, focused as it is now"
    ),
)
_BOARD = "charuco:15x9"
_LENS = "camera.toml"
_TURN_KEY = "focus_turn"
_TURN, _FIXED = "turn", "fixed"
_TURNS = (
    Choice(name=_TURN, meaning="turn the focus ring a little, and measure again"),
    Choice(name=_FIXED, meaning="both rings are fixed with their screws"),
)
_TURNS_MOST = 20
_IMPROVED = 0.95  # of the edge before: less is noise
_FIGURES = 5
_FIGURES_WITHIN_S = 300.0
_FULL_8_BITS = 255.0
_GOOD_SHARE = Threshold(
    "figures with the verdict ok", 0.8, "of all", "one of five may be disturbed", is_least=True
)


def ask_geometry(context: StageContext) -> None:
    """Ask for the distances that a tape measures, and judge what the camera then sees."""
    dialogue = context.dialogue
    geometry = context.config.optics.geometry
    if geometry.a_mm is None or geometry.b_mm is None or geometry.alpha_deg is None:
        context.note("geometry", "general poses are configured; they are kept")
    else:
        context.set_keys(
            "optics.geometry",
            a_mm=dialogue.ask_number(
                "a_mm", "mirror's vertex to the camera's pinhole", geometry.a_mm, 100, 1e5, "mm"
            ),
            b_mm=dialogue.ask_number(
                "b_mm", "mirror's vertex to the pattern's centre", geometry.b_mm, 100, 1e5, "mm"
            ),
            alpha_deg=dialogue.ask_number(
                "alpha_deg",
                "angle of either line of sight above the mirror's plane",
                geometry.alpha_deg,
                1,
                179,
                "degrees",
            ),
        )
    optics = context.config.optics
    seen = sight.trace_view(optics, optics.mirror.sag_mm)
    context.judge(
        "part of the mirror that camera and pattern can measure by the stated geometry",
        seen.measured,
        thresholds.SEEN_SHARE,
        "measure the distances again, then move the screen or use a wider lens",
    )
    doubt = sight.find_doubt(optics)
    if doubt is not None:
        context.require(f"optics.{doubt.table}.{doubt.key}", False, doubt.why, doubt.remedy)


@contextlib.contextmanager
def hold_without_camera(context: StageContext, name: str) -> Iterator[None]:
    """Hold the mirror at its depth while this session, and not the hold, uses the camera.

    Parameters
    ----------
    context : StageContext
        Of the stage.
    name : str
        Last part of the run folder's name.

    Raises
    ------
    StageFailedError
        The controller ends the hold.
    """
    try:
        with (
            without_camera(context),
            context.access.start_hold(context.folder, context.config, name) as link,
        ):
            hold_depth(context, link, context.config.loop.setpoint_um)
            yield
    except HoldError as error:
        raise StageFailedError(f"the controller ended it: {error}") from None


def focus_camera(context: StageContext) -> None:
    """Measure the sharpness of the mirror's rim while a person turns the focus ring."""
    dialogue = context.dialogue
    dialogue.wait("focus", "Aim at the whole mirror; close the diaphragm by two stops from open")
    with hold_without_camera(context, "focus"):
        edges_px: list[float] = []
        while True:
            pictures = context.access.photograph(context.config)
            edges_px.append(measure_rim_edge_px(pictures))
            if not math.isfinite(edges_px[-1]):
                raise StageFailedError(
                    "no lit mirror in the picture: aim, lens cap, screen, light on the film"
                )
            best_px = min(edges_px)
            dialogue.show(f"  rim's edge: {edges_px[-1]:.1f} px; the best so far {best_px:.1f} px")
            context.state.answers.pop(_TURN_KEY, None)
            answer = dialogue.ask_choice(
                _TURN_KEY, "the narrower the edge, the sharper", _TURNS, _find_advice(edges_px)
            )
            if answer == _FIXED:
                break
            context.access.move_hand(HandMotion(HandAct.TURN_FOCUS))
    context.judge(
        "width of the mirror's rim in the picture, 10 to 90 %",
        edges_px[-1],
        thresholds.RIM_EDGE,
        "focus on the rim, not on the screen's reflection; close the diaphragm further",
    )


def _find_advice(edges_px: list[float]) -> str:
    """Whether to turn on: while the edge is too wide, or still becomes narrower."""
    if not thresholds.RIM_EDGE.is_met(edges_px[-1]):
        return _TURN
    still_improves = len(edges_px) < 2 or edges_px[-1] < _IMPROVED * edges_px[-2]
    return _TURN if still_improves and len(edges_px) < _TURNS_MOST else _FIXED


def test_screen(context: StageContext) -> None:
    """Measure exposure, pattern, settling and response of the screen with the camera."""
    if "screen" not in read_tables(context.folder)["devices"]:
        context.leave_out(
            "exposure, pattern, settling and response", "this camera brings its own patterns"
        )
        return
    with hold_without_camera(context, "screen"):
        probes = context.access.probe_optics(context.config)
    for probe in probes:
        seen = probe.problem or f"{probe.identity}: {probe.reading}; {probe.notes}"
        context.require(f"camera and screen on {probe.device}", not probe.problem, seen)


def measure_figure(context: StageContext) -> None:
    """Hold the mirror and judge its first figures."""
    try:
        with context.access.start_hold(
            context.folder, context.config, "figure", by_frames=True
        ) as link:
            hold_depth(context, link, context.config.loop.setpoint_um)
            # Figures come with the news of the hold, every two seconds.
            found: list[ShapeEstimate] = []
            waited_s = 0.0
            while len(found) < _FIGURES and waited_s < _FIGURES_WITHIN_S:
                news = read_sound_news(link)
                found += news.shapes
                if len(news.rows) > 1:
                    waited_s += news.rows[-1].mono_s - news.rows[0].mono_s
    except HoldError as error:
        raise StageFailedError(f"the controller ended it: {error}") from None
    if len(found) < _FIGURES:
        context.require(
            "first figures",
            False,
            f"{len(found)} in {_FIGURES_WITHIN_S:g} s",
            "read the events of the run (`membrane-ctrl runs show last`)",
        )
        return
    good = [figure for figure in found if figure.verdict == "ok"]
    context.judge("figures with the verdict ok", len(good) / len(found), _GOOD_SHARE)
    context.judge(
        "part of the mirror that a figure measures",
        float(np.median([figure.valid_fraction for figure in found])),
        thresholds.VALID_FRACTION,
        "look at a frame: shadows, the rim, the screen's border",
    )
    full_scale = float(1 << context.config.optics.camera.bits)
    modulation = float(np.median([figure.modulation_median_adu for figure in found]))
    context.judge(
        "median modulation of the fringes",
        modulation * _FULL_8_BITS / full_scale,
        thresholds.MODULATION,
        "focus, expose longer, or brighten the screen",
    )
    if context.access.simulated:
        context.note("origin of these figures", "frames rendered of the twin's film")


def calibrate_optics(context: StageContext) -> None:
    """Calibrate what the things at hand allow, and state what that leaves."""
    dialogue = context.dialogue
    at_hand = dialogue.ask_choice(
        "calibration.with", "what is at hand for a calibration?", _AT_HAND, _BY_HAND
    )
    if at_hand == _BY_HAND:
        context.note("lens", "as stated")
    else:
        photographs = dialogue.ask_text(
            "calibration.photographs", "folder of the photographs", is_needed=True
        )
        board = dialogue.ask_text("calibration.board", "the board", _BOARD)
        lens = context.folder / _LENS
        command = [*OWN_PROGRAM, "calibrate-camera", photographs, "--board", board]
        command += ["--config", str(context.folder / CONFIGURATION), "--out", str(lens)]
        code = run_shown(command, dialogue.show)
        context.require(
            "lens from photographs of a board",
            code == 0,
            str(lens) if code == 0 else f"exit code {code}",
            "read the messages above; photograph the board tilted in all directions",
        )
    context.note(
        "geometry",
        "by hand: expect 12 µm RMS of height error; then `membrane-ctrl calibrate --live` on a "
        "hold, which takes sets at several depths",
    )


def has_camera(state: SessionState, tables: TomlTable) -> bool:
    """Whether a camera is configured, so that the stages of the optics are needed.

    Parameters
    ----------
    state : SessionState
        Not used; every stage's `is_needed` gets it.
    tables : TomlTable
        The configuration as it is in the file; empty before it is written.
    """
    return "camera" in tables.get("devices", {})
