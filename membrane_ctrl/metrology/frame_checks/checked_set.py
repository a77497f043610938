"""The full result of a capture set: frames checked, every pixel's phase and slopes, the fit, and
the zonal map.

Bins come first: they give the fringe orders, a surface, and what each frame should have shown.
Frames that do not belong are left out, one at a time since one bad frame spoils the prediction of
the others, until the rest agree. Then every pixel is measured, its period taken from its bin.
"""

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig, PatternConfig
from membrane_ctrl.metrology.frame_checks import backlight_bands, frame_evidence, frame_faults
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.phase.fringe_orders import orders
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.metrology.phase.screen_scale import centre_phase_rad, inside_pattern, mm_per_rad
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.reconstruction import bin_grid, tracked_points
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray
from membrane_ctrl.model.shape_estimate import RESIDUAL_REJECTED_URAD, Verdict

_ROUNDS = 8
_MANY_BLAMED = 3
# Below, the light is called even: it leaves 0.02 µm in the figure, and a blurred set seems to
# differ by as much.
_UNEVEN = 2e-3
# from the pattern's edge: a blurred picture of it says nothing of a frame's light
_BLURRED_RAD = 2.0
_LIGHT_KNOWN = 3e-4  # what another round would change, once it is not even
# A point whose phase moved further than this between two sets may have been taken for its neighbour
# a period away
_GUARD_RAD = 0.9 * math.pi
_LOST_SHARE = 0.01
# the ring's plane is crossed this far at most from where the ray meets the film
_FILM_BESIDE_PLANE_MM = 25.0
# With these few of an axis' bits contradicting the orders, no other set of orders explains the rest
_BIT_MISMATCH = 0.02


@dataclass(frozen=True)
class Anchor:
    """What a full set passes on to the fringes sets that refer to it."""

    phase_rad: FloatArray  # (2, rows, columns): absolute phases of the bins; NaN where unknown
    light: FloatArray  # (rows, columns): of the bins


@dataclass(frozen=True)
class Checked:
    """A set whose frames have been checked and whose bins have been fitted."""

    stack: frame_stack.FrameStack  # the frames, swapped ones put back
    binned: frame_stack.Binned  # the frames over bins
    view: frame_evidence.BinView  # evidence from the usable frames
    phase_rad: FloatArray  # (2, rows, columns): absolute phases of the bins
    near: BoolArray  # (rows, columns): bins that may see the mirror
    tracer: ray_tracing.Tracer  # the bench, with the vertex where the laser saw it
    state: tracked_points.TrackedPoints  # the bins' points with their surface
    flags: tuple[frame_faults.Flag, ...]  # frames that do not belong
    # (n,): of the used sinusoids, x and then y: where the fringes put the film, about its mean
    film_um: FloatArray
    film_noise_um: float  # 1 sigma of each of these places
    light_left: float  # RMS of their light, relative, that the phases do not know of

    @property
    def verdict(self) -> tuple[Verdict, str]:
        """Verdict from the frames alone: "ok", or "degraded" with the reason."""
        if self.flags:
            return (
                "degraded",
                f"{len(self.flags)} frame(s) flagged; the figure excludes the affected data",
            )
        doubt = backlight_bands.doubt(self.stack.gain)
        return ("degraded", doubt) if doubt else ("ok", "")

    def places_px(self, index: IntArray) -> FloatArray:
        """Column and row (2, n) of bins' centres."""
        row, column = np.divmod(index, self.phase_rad.shape[2])
        return self.binned.bin_px * np.stack([column, row]) + (self.binned.bin_px - 1) / 2

    def anchor(self) -> Anchor:
        """For the sets that refer to this one."""
        return Anchor(self.phase_rad, self.view.light)


class RejectedSetError(frame_evidence.NoFigureError):
    """A set that gives no figure, with the bad frames."""

    def __init__(self, reason: str, flags: tuple[frame_faults.Flag, ...]) -> None:
        super().__init__(reason)
        self.flags = flags


def vertex_z_mm(optics: OpticsConfig, displacement_um: float) -> float:
    """Position of the vertex at a displacement: z = -(d - reference)."""
    reference = optics.geometry.reference_displacement_um
    return (
        0.0
        if reference is None or not math.isfinite(displacement_um)
        else -(displacement_um - reference) * 1e-3
    )


def check(
    stack: frame_stack.FrameStack, optics: OpticsConfig, anchor: Anchor | None = None
) -> Checked:
    """Check the frames and fit the bins. Raises RejectedSetError if the frames do not give a
    figure.

    `anchor` gives a set without Gray code its fringe orders; `camera.bits` of the optics sets
    saturation.
    """
    stack, binned, _ = backlight_bands.without_bands(
        stack, frame_stack.bin_frames(stack, 2**optics.camera.bits - 1)
    )
    try:
        found = _check(stack, binned, optics, anchor)
    except RejectedSetError as error:
        put_back = _put_back(stack, binned, optics, anchor)
        if put_back is None:
            raise RejectedSetError(str(error) + _doubt(stack, error.flags), error.flags) from None
        return put_back
    return (
        found if _believable_surface(found) else _put_back(stack, binned, optics, anchor) or found
    )


def _doubt(stack: frame_stack.FrameStack, flags: tuple[frame_faults.Flag, ...]) -> str:
    """Where many frames differ from the prediction, the doubt that the prediction, that is the
    geometry, is wrong.

    Pictures that are the same, unreadable or dark need no prediction.
    """
    sinusoids = [flag for flag in flags if stack.patterns[flag.frame].role == "sin"]
    blamed = [flag for flag in sinusoids if flag.defect in frame_faults.FOUND_BY_PREDICTION]
    if len(blamed) < _MANY_BLAMED:
        return ""
    return "; with this many frames blamed, check the geometry and the axes of these pictures"


def _believable_surface(checked: Checked) -> bool:
    """Whether the slopes are those of one surface: steps that run backwards agree with every frame,
    not with it.
    """
    field = checked.tracer.slope_field(checked.state.points, checked.state.surface)
    return (
        1e6 * float(np.sqrt(np.mean(np.square(field[2:4] - field[4:6])))) <= RESIDUAL_REJECTED_URAD
    )


def _put_back(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    optics: OpticsConfig,
    anchor: Anchor | None,
) -> Checked | None:
    """The set with two sinusoids of an axis exchanged, if one exchange alone makes all frames
    agree.

    Three steps that run backwards predict every frame wrongly, so no frame can be blamed for what
    it shows. The Gray code and the surface decide: of all exchanges only the right one leaves no
    frame to be flagged.
    """
    if (
        stack.unusable or len(stack.sinusoids(AXES[0])) > 3
    ):  # the good ones of four steps name a swapped pair
        return None
    found: list[Checked] = []
    for axis in AXES:
        for a, b in combinations(stack.sinusoids(axis), 2):
            order = list(range(len(stack.patterns)))
            order[a], order[b] = b, a
            try:
                checked = _check(
                    stack.reordered(order), binned.reordered(order), optics, anchor, rounds=2
                )
            except RejectedSetError:
                continue
            if not checked.flags and _believable_surface(checked):
                pair = ((a, b), (b, a))
                flags = tuple(_flag_swapped(k, stack.patterns[j].name, j) for k, j in pair)
                found.append(replace(checked, flags=flags))
    return found[0] if len(found) == 1 else None


def _flag_swapped(frame: int, shown: str, swapped_with: int) -> frame_faults.Flag:
    return frame_faults.Flag(
        frame, frame_faults.FrameDefect.SWAPPED, f"swapped with {shown}", math.inf, swapped_with
    )


def _check(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    optics: OpticsConfig,
    anchor: Anchor | None,
    rounds: int = _ROUNDS,
) -> Checked:
    """The set as it is, without frames that do not belong, in a limited number of rounds. Raises
    RejectedSetError.
    """
    geometry = Geometry.from_config(optics)
    grid = bin_grid.BinGrid(geometry, optics.camera, binned.bin_px)
    near = grid.near_mirror(optics.mirror.analysis_radius_mm + _FILM_BESIDE_PLANE_MM)
    known = {
        frame: frame_faults.flag_unreadable(frame, reason)
        for frame, reason in stack.unusable.items()
    }
    known |= {flag.frame: flag for flag in frame_faults.obvious(stack, binned)}
    excluded = set(known)
    flags: list[frame_faults.Flag] = []
    for done in range(rounds + 1):
        try:
            attempt = _attempt(stack, binned, optics, geometry, grid, near, excluded, anchor)
        except (frame_evidence.NoFigureError, ValueError) as error:
            raise RejectedSetError(str(error), _merged(_believable(stack, flags), known)) from None
        readable = [k for k in range(len(stack.patterns)) if k not in stack.unusable]
        seen = frame_evidence.gather(stack, binned, attempt.scene, readable)
        flags = frame_faults.inspect(stack, seen, excluded)
        fresh = [flag for flag in flags if flag.frame not in excluded]
        if not fresh:
            inner = np.all(
                inside_pattern(attempt.scene.phase_rad, optics.pattern, _BLURRED_RAD), axis=0
            )
            scene = attempt.scene.part(inner) if np.mean(inner) > 1 / 2 else attempt.scene
            flat = attempt.phase_rad.reshape(2, -1)
            light, film_um, noise_um = frame_evidence.light_and_film(
                stack, binned, scene, attempt.view.used, flat
            )
            left = light - (1.0 if stack.light is None else stack.light)
            if (
                np.abs(left).max() > (_UNEVEN if stack.light is None else _LIGHT_KNOWN)
                and done < rounds
            ):
                stack = replace(stack, light=light)  # a round with the light that each frame had
                continue
            _confirm_orders(
                stack, attempt.phase_rad, binned, attempt.view, excluded, _merged(flags, known)
            )
            shape = attempt.view.mask.shape
            fitted = (
                attempt.view,
                attempt.phase_rad,
                near.reshape(shape),
                attempt.tracer,
                attempt.state,
            )
            light_left = float(
                np.sqrt(
                    np.mean(np.square(left[:, [k for axis in attempt.view.used for k in axis]]))
                )
            )
            return Checked(
                stack, binned, *fitted, _merged(flags, known), film_um, noise_um, light_left
            )
        pair = next((flag for flag in fresh if flag.swapped_with is not None), None)
        if (
            pair is not None
            and pair.swapped_with is not None
            and not {pair.frame, pair.swapped_with} & set(known)
        ):
            order = list(range(len(stack.patterns)))
            order[pair.frame], order[pair.swapped_with] = pair.swapped_with, pair.frame
            stack, binned = stack.reordered(order), binned.reordered(order)
            known |= {
                flag.frame: flag for flag in flags if flag.frame in (pair.frame, pair.swapped_with)
            }
            continue
        # the worst sinusoid alone may spoil the predictions of the others
        chosen = {flag.frame: flag for flag in _of_sinusoids(stack, fresh)[:1] or fresh}
        known |= chosen
        excluded |= set(chosen)
    reason = "the frames do not agree, whichever are left out"
    raise RejectedSetError(reason, _merged(_believable(stack, flags), known))


@dataclass(frozen=True)
class _Attempt:
    view: frame_evidence.BinView
    phase_rad: FloatArray
    tracer: ray_tracing.Tracer
    state: tracked_points.TrackedPoints
    scene: frame_evidence.SampledBins


def _attempt(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    optics: OpticsConfig,
    geometry: Geometry,
    grid: bin_grid.BinGrid,
    near: BoolArray,
    excluded: set[int],
    anchor: Anchor | None,
) -> _Attempt:
    """Fit the bins without the excluded frames. Raises NoFigureError
    or ValueError if that fails.
    """
    tracer = ray_tracing.Tracer(
        geometry, optics.mirror.radius_mm, vertex_z_mm(optics, stack.mean_reading_um)
    )
    view = frame_evidence.look(stack, binned, excluded, None if anchor is None else anchor.light)
    phase = _absolute(stack, binned, view, anchor, optics)
    candidates = np.flatnonzero(near)
    flat = phase.reshape(2, -1)[:, candidates]
    state = tracked_points.establish(
        grid, tracer, candidates, flat, optics.pattern, optics.mirror.analysis_radius_mm
    )
    predicted = tracer.predict_screen(state.points, state.surface) / mm_per_rad(optics.pattern)
    light = view.light.reshape(-1)[state.index]
    at = predicted + centre_phase_rad(optics.pattern)
    scene = frame_evidence.SampledBins(state.index, light, at, state.sensitivity_rad_per_um)
    return _Attempt(view, phase, tracer, state, scene)


def _of_sinusoids(
    stack: frame_stack.FrameStack, flags: list[frame_faults.Flag]
) -> list[frame_faults.Flag]:
    return [flag for flag in flags if stack.patterns[flag.frame].role == "sin"]


def _believable(
    stack: frame_stack.FrameStack, flags: list[frame_faults.Flag]
) -> list[frame_faults.Flag]:
    """While sinusoids are wrong the prediction may be wrong too: then only they are named."""
    return _of_sinusoids(stack, flags) or flags


def _merged(
    flags: list[frame_faults.Flag], known: dict[int, frame_faults.Flag]
) -> tuple[frame_faults.Flag, ...]:
    """All flags in the order of the frames; the latest inspection takes precedence, earlier
    findings remain.
    """
    named = {
        **known,
        **{flag.frame: flag for flag in flags if known.get(flag.frame, flag).swapped_with is None},
    }
    return tuple(named[frame] for frame in sorted(named))


def _absolute(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    view: frame_evidence.BinView,
    anchor: Anchor | None,
    optics: OpticsConfig,
) -> FloatArray:
    """Absolute phases of the bins, (2, rows, columns); NaN where not valid."""
    if anchor is not None:
        return _followed(view, anchor)
    return absolute_phases(stack, binned, view, optics.pattern)


def absolute_phases(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    view: frame_evidence.BinView,
    pattern: PatternConfig,
) -> FloatArray:
    """Those of a set with Gray code, by that alone."""
    out = np.empty_like(view.phase_rad)
    for k, axis in enumerate(AXES):
        # the fringes' mean is half the light, which no single frame can spoil
        bits = binned.means[stack.gray(axis)] > view.light
        phase = orders(view.phase_rad[k], bits, view.mask).phase_rad
        out[k] = np.where(inside_pattern(phase, pattern), phase, np.nan)
    return out


def _followed(view: frame_evidence.BinView, anchor: Anchor) -> FloatArray:
    """Phases next to the anchor's. Raises NoFigureError if the film moved too far to tell."""
    change = np.angle(np.exp(1j * (view.phase_rad - anchor.phase_rad)))
    seen = view.mask & np.isfinite(anchor.phase_rad).all(axis=0)
    lost = float(np.mean(np.abs(change[:, seen]).max(axis=0) > _GUARD_RAD)) if seen.any() else 1.0
    if lost > _LOST_SHARE:
        raise frame_evidence.NoFigureError(
            f"the phase moved by half a period from the reference at {lost:.0%} of the points"
        )
    return np.where(seen, anchor.phase_rad + change, np.nan)


def _confirm_orders(
    stack: frame_stack.FrameStack,
    phase_rad: FloatArray,
    binned: frame_stack.Binned,
    view: frame_evidence.BinView,
    excluded: set[int],
    flags: tuple[frame_faults.Flag, ...],
) -> None:
    """Raise unless the usable Gray bits of each axis allow no other orders than those taken."""
    for k, axis in enumerate(AXES):
        gray = stack.gray(axis)
        good = [bit for bit, frame in enumerate(gray, start=1) if frame not in excluded]
        if not gray or len(good) == len(gray):
            continue
        seen = np.isfinite(phase_rad[k])
        phase = phase_rad[k][seen]
        bits = {bit: (binned.means[gray[bit - 1]] > view.light)[seen] for bit in good}
        explained = [
            shift for shift in range(-7, 8) if _explains(phase + 2 * math.pi * shift, bits)
        ]
        if explained != [0]:
            raise RejectedSetError(
                f"the {axis} fringe orders are not certain without all Gray frames", flags
            )


def _explains(phase_rad: FloatArray, bits: dict[int, BoolArray]) -> bool:
    """Whether these orders lie in the pattern and show these bits, away from the bits' edges."""
    if np.min(phase_rad) < -1.5 * math.pi or np.max(phase_rad) > 15.5 * math.pi:
        return False
    for bit, seen in bits.items():
        shown, from_edge = gray_bit(phase_rad, bit)
        sure = from_edge > 0.5
        if np.mean(shown[sure] != seen[sure]) > _BIT_MISMATCH:
            return False
    return bool(bits)
