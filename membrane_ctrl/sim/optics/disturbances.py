"""What disturbs the pictures of a real bench: light, room, dust, air and the camera's mount.

Each effect is a map over the nodes of `shade`: two move the point of the screen that a ray meets,
two change the counts. The amplitudes are settings (`[twin.disturbances]`); sizes of waves and
spots, and times, are constants.
"""

import math
from dataclasses import dataclass

import numpy as np

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.optics import DisturbancesConfig
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.optics.random_field import RandomField

# Brightness of the screen: length of the waves on it, and their memory.
_BRIGHT_MM = 75.0
_BRIGHT_S = 60.0
# Cells of warm air over the mirror, and their memory.
_AIR_MM = 400.0
_AIR_S = 0.5
# Dust: how long it lies in one place, radius of a spot and its loss of light.
_DUST_S = 25.0
_DUST_MM = 6.0
_DUST_LOSS = 0.6
# Pulsed backlight: exposure of a picture, and share of the time in which it is lit.
_EXPOSURE_S = 0.02
_LIT_SHARE = 0.7
_RETENTION_S = 3600.0  # a panel's memory of the pictures that it has shown
# Camera's mount: growth of 2.6 m of aluminium, and period of an air conditioner.
_GROWTH_MM_PER_K = 0.060
_WARMS_S = 1200.0
# Room light: its slope across the mirror, its swing, and the period of that.
_SLOPE = 0.3
_SWING = 0.2
_SWING_S = 120.0


@dataclass(frozen=True)
class Nodes:
    """Where the nodes of a picture are, on a bench at rest; maps are (rows, columns).

    Attributes
    ----------
    s_x_mm, s_y_mm : (rows, columns) arrays
        On the screen, from the low edge of the pattern's region.
    x_mm, y_mm : (rows, columns) arrays
        On the mirror.
    row_share : (rows,) array
        Row, as a share of the picture's height from its middle.
    side_mm : float
        Side of the pattern's region.
    radius_mm : float
    full_adu : float
    grown : (3, rows, columns) array
        Change of the renderer's maps by 1 mm of growth of the camera's mount.
    """

    s_x_mm: FloatArray
    s_y_mm: FloatArray
    x_mm: FloatArray
    y_mm: FloatArray
    row_share: FloatArray
    side_mm: float
    radius_mm: float
    full_adu: float
    grown: FloatArray


class Disturber:
    """The disturbances of one bench, picture after picture.

    Parameters
    ----------
    wanted : DisturbancesConfig
        Size of each disturbance; 0 is none.
    nodes : Nodes
        Where the nodes of a picture are.
    seed : int
        Equal seeds and times give equal pictures.
    """

    def __init__(self, wanted: DisturbancesConfig, nodes: Nodes, seed: int) -> None:
        self._wanted = wanted
        self._nodes = nodes
        self._seed = seed
        rngs = [np.random.default_rng([seed, k]) for k in range(3)]
        self._bright = RandomField(_BRIGHT_MM, _BRIGHT_S, nodes.side_mm / 2, rngs[0])
        self._air = [RandomField(_AIR_MM, _AIR_S, nodes.radius_mm, rng) for rng in rngs[1:]]
        # Number of the last change of the dust, and the share of light that passes since then.
        self._dust = (-1, np.ones_like(nodes.x_mm))
        # What the panel retains: phasors of the x and the y fringes, and when that was computed.
        self._retained = np.zeros(2, complex)
        self._retained_s = 0.0

    def row_times_s(self, time_s: float) -> FloatArray:
        """Middle of the exposure of each row of nodes, (rows, 1)."""
        return time_s + self._wanted.rolling_s * self._nodes.row_share[:, None]

    def ray_disturbance(self, time_s: float) -> FloatArray:
        """What to add to the renderer's maps, (3, rows, columns): the mount's growth, and air that
        bends the rays.
        """
        wanted = self._wanted
        nodes = self._nodes
        warm_k = wanted.camera_mount_k * math.sin(2 * math.pi * time_s / _WARMS_S)
        moved = _GROWTH_MM_PER_K * warm_k * nodes.grown
        if wanted.seeing_um:
            for k, air in enumerate(self._air):
                bent = air.evaluate_at(time_s, nodes.x_mm, nodes.y_mm)
                moved[k] += 1e-3 * wanted.seeing_um * bent
        return moved

    def light_disturbance(self, time_s: float, pattern: Pattern) -> FloatArray:
        """Return what disturbs the light at a moment.

        Parameters
        ----------
        time_s : float
            The moment.
        pattern : Pattern
            What the screen shows.

        Returns
        -------
        (2, rows, columns) array
            Factor of the screen's light, and counts of the room's, at the nodes.
        """
        wanted = self._wanted
        nodes = self._nodes
        # The screen: dust, bands of the backlight, ageing, patches, and what the last picture left.
        factor = self._dust_at(time_s) * self._backlight_factor(self.row_times_s(time_s))
        factor = factor * math.exp(-wanted.dimming_fraction_per_h * time_s / 3600.0)
        if wanted.brightness_fraction:
            half_mm = nodes.side_mm / 2
            brighter = self._bright.evaluate_at(
                time_s, nodes.s_x_mm - half_mm, nodes.s_y_mm - half_mm
            )
            factor *= 1.0 + wanted.brightness_fraction * brighter
        if wanted.sticking_fraction and pattern.role == "crossed":
            factor *= 1.0 - wanted.sticking_fraction * self._retained_level(time_s, pattern)
        # The room: brighter on one side, and swinging slowly.
        swing = _SWING * math.sin(2 * math.pi * time_s / _SWING_S)
        room_factor = 1.0 + _SLOPE * nodes.x_mm / nodes.radius_mm + swing
        room_adu = wanted.ambient_fraction * nodes.full_adu * room_factor
        return np.stack([factor, room_adu])

    def _dust_at(self, time_s: float) -> FloatArray:
        """Share of light that passes; the spots change their places every 25 s."""
        # Computed when the spots have moved; their places follow from seed and number of the move.
        nodes = self._nodes
        change = math.floor(time_s / _DUST_S)
        if self._wanted.dust and self._dust[0] != change:
            places_mm = np.random.default_rng([self._seed, 3, change % 2**32]).uniform(
                -nodes.radius_mm, nodes.radius_mm, (self._wanted.dust, 2)
            )
            passes = np.ones_like(nodes.x_mm)
            for x_mm, y_mm in places_mm:
                distance_mm2 = (nodes.x_mm - x_mm) ** 2 + (nodes.y_mm - y_mm) ** 2
                passes *= 1.0 - _DUST_LOSS * np.exp(-distance_mm2 / (2 * _DUST_MM**2))
            self._dust = change, passes
        return self._dust[1].copy()

    def _backlight_factor(self, middle_s: FloatArray) -> FloatArray:
        """Light of an exposure over the mean, from the pulses of the backlight that it contains."""
        hz = self._wanted.backlight_hz
        if not hz:
            return np.ones_like(middle_s)

        def lit_turns(turns: FloatArray) -> FloatArray:
            """Lit part of so many periods from the start of a pulse."""
            whole = np.floor(turns)
            return np.asarray(whole * _LIT_SHARE + np.minimum(turns - whole, _LIT_SHARE))

        # Lit part of the exposure, from its begin to its end, over that of a steady light.
        half_s = _EXPOSURE_S / 2
        lit = lit_turns(hz * (middle_s + half_s)) - lit_turns(hz * (middle_s - half_s))
        return np.asarray(lit / (_LIT_SHARE * hz * _EXPOSURE_S))

    def _retained_level(self, time_s: float, pattern: Pattern) -> FloatArray:
        """Level, 0 to 1, of the picture that the panel retains: the mean of the patterns shown so
        far, with an exponential memory.
        """
        nodes = self._nodes
        # The mean phasor of each axis, with the pattern that is shown now.
        shown = np.exp(1j * np.array([pattern.shift_rad, pattern.shift_y_rad]))
        keep = math.exp(min(0.0, self._retained_s - time_s) / _RETENTION_S)
        self._retained = keep * self._retained + (1.0 - keep) * shown
        self._retained_s = time_s
        # Fringes with that contrast and phase, at the nodes.
        rad_per_mm = 2 * math.pi * pattern.index / nodes.side_mm
        wave_x, wave_y = (
            np.real(phasor * np.exp(1j * (rad_per_mm * s_mm - math.pi)))
            for phasor, s_mm in zip(self._retained, (nodes.s_x_mm, nodes.s_y_mm), strict=True)
        )
        return np.asarray(0.5 + 0.25 * (wave_x + wave_y))
