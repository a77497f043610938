"""What disturbs the pictures of a real bench: light, room, dust, air, the camera's stand, and the
film's vibrations.

Each effect is a map over the nodes of `shade`: two move the point of the screen that a ray meets,
two change the counts. The amplitudes are settings (`[twin.disturbances]`); sizes of waves and
spots, and times, are not.
"""

import math
from dataclasses import dataclass

import numpy as np

from firmware_iface.roles import Pattern
from membrane_ctrl.config.optics import DisturbancesConfig
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.optics.random_field import RandomField

_BRIGHT_MM = 75.0  # lengths of the waves on the screen, and memory
_BRIGHT_S = 60.0
_AIR_MM = 400.0  # of cells of warm air over the mirror
_AIR_S = 0.5
_DUST_S, _DUST_MM, _DUST_LOSS = (
    25.0,
    6.0,
    0.6,
)  # how long it lies; radius and loss of light of a spot
_EXPOSURE_S = 0.02  # of a pulse of the backlight
_LIT_SHARE = 0.7
_STICKING_S = 3600.0  # a panel's memory
_GROWTH_MM_PER_K, _WARMS_S = (
    0.060,
    1200.0,
)  # of an aluminium stand of 2.6 m; period of an air conditioner
_SLOPE = 0.3  # of the room's light: across the mirror, and in time
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
        Change of the renderer's maps by 1 mm of the stand.
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
    """The disturbances of one bench, picture after picture. Equal seeds and times give equal
    pictures.
    """

    def __init__(self, wanted: DisturbancesConfig, nodes: Nodes, seed: int) -> None:
        self._wanted, self._nodes, self._seed = wanted, nodes, seed
        rngs = [np.random.default_rng([seed, k]) for k in range(3)]
        self._bright = RandomField(_BRIGHT_MM, _BRIGHT_S, nodes.side_mm / 2, rngs[0])
        self._air = [RandomField(_AIR_MM, _AIR_S, nodes.radius_mm, rng) for rng in rngs[1:]]
        self._dust = (-1, np.ones_like(nodes.x_mm))  # since which change, and what it lets through
        self._burnt, self._shown_s = np.zeros(2, complex), 0.0

    def row_times_s(self, time_s: float) -> FloatArray:
        """Middle of the exposure of each row of nodes, (rows, 1)."""
        return time_s + self._wanted.rolling_s * self._nodes.row_share[:, None]

    def ray_disturbance(self, time_s: float) -> FloatArray:
        """What to add to the renderer's maps, (3, rows, columns): the stand's growth, and air that
        bends the rays.
        """
        wanted, nodes = self._wanted, self._nodes
        warm_k = wanted.stand_k * math.sin(2 * math.pi * time_s / _WARMS_S)
        moved = _GROWTH_MM_PER_K * warm_k * nodes.grown
        if wanted.seeing_um:
            for k, air in enumerate(self._air):
                moved[k] += (
                    1e-3 * wanted.seeing_um * air.evaluate_at(time_s, nodes.x_mm, nodes.y_mm)
                )
        return moved

    def light_disturbance(self, time_s: float, pattern: Pattern) -> FloatArray:
        """Factor of the screen's light, and counts of the room's, (2, rows, columns)."""
        wanted, nodes = self._wanted, self._nodes
        factor = self._dust_at(time_s) * self._backlight_factor(self.row_times_s(time_s))
        factor = factor * math.exp(-wanted.dimming_fraction_per_h * time_s / 3600.0)
        if wanted.brightness_fraction:
            half_mm = nodes.side_mm / 2
            factor *= 1.0 + wanted.brightness_fraction * self._bright.evaluate_at(
                time_s, nodes.s_x_mm - half_mm, nodes.s_y_mm - half_mm
            )
        if wanted.sticking_fraction and pattern.role == "crossed":
            factor *= 1.0 - wanted.sticking_fraction * self._retained_level(time_s, pattern)
        swing = _SWING * math.sin(2 * math.pi * time_s / _SWING_S)
        room_adu = (
            wanted.ambient_fraction
            * nodes.full_adu
            * (1.0 + _SLOPE * nodes.x_mm / nodes.radius_mm + swing)
        )
        return np.stack([factor, room_adu])

    def _dust_at(self, time_s: float) -> FloatArray:
        """Share of light that passes; the spots lie elsewhere every now and then."""
        nodes, change = self._nodes, math.floor(time_s / _DUST_S)
        if self._wanted.dust and self._dust[0] != change:
            places_mm = np.random.default_rng([self._seed, 3, change % 2**32]).uniform(
                -nodes.radius_mm, nodes.radius_mm, (self._wanted.dust, 2)
            )
            passes = np.ones_like(nodes.x_mm)
            for x_mm, y_mm in places_mm:
                away2_mm2 = (nodes.x_mm - x_mm) ** 2 + (nodes.y_mm - y_mm) ** 2
                passes *= 1.0 - _DUST_LOSS * np.exp(-away2_mm2 / (2 * _DUST_MM**2))
            self._dust = change, passes
        return self._dust[1].copy()

    def _backlight_factor(self, middle_s: FloatArray) -> FloatArray:
        """Light of an exposure over the mean: how much of it falls into the pulses of the
        backlight.
        """
        hz = self._wanted.backlight_hz
        if not hz:
            return np.ones_like(middle_s)

        def pulses(turns: FloatArray) -> FloatArray:
            whole = np.floor(turns)
            return np.asarray(whole * _LIT_SHARE + np.minimum(turns - whole, _LIT_SHARE))

        half_s = _EXPOSURE_S / 2
        lit = pulses(hz * (middle_s + half_s)) - pulses(hz * (middle_s - half_s))
        return np.asarray(lit / (_LIT_SHARE * hz * _EXPOSURE_S))

    def _retained_level(self, time_s: float, pattern: Pattern) -> FloatArray:
        """Level, 0 to 1, of the picture that the panel remembers: the mean of the patterns shown so
        far.
        """
        nodes = self._nodes
        now = np.exp(1j * np.array([pattern.shift_rad, pattern.shift_y_rad]))
        keep = math.exp(min(0.0, self._shown_s - time_s) / _STICKING_S)
        self._burnt, self._shown_s = keep * self._burnt + (1.0 - keep) * now, time_s
        rate = 2 * math.pi * pattern.index / nodes.side_mm
        waves = [
            np.real(burnt * np.exp(1j * (rate * s_mm - math.pi)))
            for burnt, s_mm in zip(self._burnt, (nodes.s_x_mm, nodes.s_y_mm), strict=True)
        ]
        return np.asarray(0.5 + 0.25 * (waves[0] + waves[1]))
