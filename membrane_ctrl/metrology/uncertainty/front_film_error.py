"""Errors of the figure by what is not known of a front film: rows of the budget.

The gas lens is 6 to 20 um on the screen, and errors of its parts are smaller still: to first order
a ray is turned by the gas' excess of index times the film's slope, and by (index - 1) times the
slope of its thickness, once on each way.
"""

from dataclasses import replace

import numpy as np

from membrane_ctrl.config.front_film import FrontFilmConfig
from membrane_ctrl.metrology.rays.cushion import Cushion
from membrane_ctrl.metrology.rays.gas_lens import trace_gas_lens
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import FloatArray

# Form of the film beside its bowl: saddles in mm on the rim, as of a mirror clamped by hand; and
# the difference of film laws at this depth, of the shape v (1 - v), mm at its highest.
_SADDLE_MM = 0.7
_ROUND_MM = 0.2
_WAYS = 2  # a ray passes the film twice


def front_film_sources(bench: TrialBench) -> list[Source]:
    """Return the rows for a front film; none for a single film.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    """
    front = bench.optics.mirror.front_film
    geometry = bench.geometry().geometry
    cushion = geometry.cushion
    if front is None or cushion is None:
        return []

    # Places of the points on the mirror, and by how much a unit turn moves the screen points.
    rays = geometry.rays(bench.column_px, bench.row_px)
    point = geometry.pinhole_mm[:, None] + bench.t_mm * rays
    reach_mm = np.linalg.norm(geometry.screen_points(bench.screen_mm) - point, axis=0)
    by_turn_mm = _WAYS * reach_mm * geometry.screen_axes[:2, :2, None]
    unit = point[:2] / cushion.radius_mm

    # The film one sigma off in its bulge, its gas and its thickness.
    bulged = replace(cushion, bulge_mm=cushion.bulge_mm + front.bulge_sigma_mm)
    denser = replace(cushion, gas_excess=cushion.gas_excess * (1 + front.gas_sigma_relative))
    thicker_mm = cushion.thickness_mm * (1 + front.thickness_sigma_relative)
    thicker = replace(cushion, thickness_mm=thicker_mm)

    # Form and evenness turn the rays by the slopes that they add: by the gas as a prism of its
    # excess, by the film as one of its index.
    return [
        _row(
            bench,
            "front_film_bulge_mm",
            "bulge of the front film",
            front.bulge_sigma_mm,
            [_lens_change_mm(bench, bulged, point)],
        ),
        _row(
            bench,
            "front_film_gas",
            "index of the gas behind the front film",
            front.gas_sigma_relative,
            [_lens_change_mm(bench, denser, point)],
        ),
        _row(
            bench,
            "front_film_form_mm",
            "form of the front film beside its bowl",
            _SADDLE_MM,
            [
                np.einsum("ijn,jn->in", by_turn_mm, cushion.gas_excess * slopes)
                for slopes in _form_slopes(unit, cushion.radius_mm)
            ],
        ),
        _row(
            bench,
            "front_film_thickness_um",
            "thickness of the front film, and its evenness",
            1e3 * (thicker_mm - cushion.thickness_mm),
            [
                _lens_change_mm(bench, thicker, point),
                *(
                    np.einsum("ijn,jn->in", by_turn_mm, (cushion.film_index - 1) * slopes)
                    for slopes in _thickness_slopes(unit, cushion, front)
                ),
            ],
        ),
    ]


def _row(
    bench: TrialBench, name: str, description: str, sigma: float, moved_mm: list[FloatArray]
) -> Source:
    """A row of independent errors of the screen points, (2, n) each."""
    effects = [
        bench.solve(bench.geometry(), off_mm, linear=True) - bench.surface.parameters
        for off_mm in moved_mm
    ]
    return Source(name, description, sigma, np.stack(effects, axis=1))


def _lens_change_mm(bench: TrialBench, other: Cushion, point: FloatArray) -> FloatArray:
    """Change (2, n) of the gas lens at points (3, n) of the mirror by another cushion."""
    geometry = bench.geometry().geometry
    if geometry.gas_lens is None:
        return np.zeros((2, point.shape[1]))
    lens = trace_gas_lens(
        other, geometry.pinhole_mm, geometry.screen_origin_mm, geometry.screen_axes
    )
    x_mm = np.ascontiguousarray(point[0])
    y_mm = np.ascontiguousarray(point[1])
    sag_mm = bench.surface.sag_mm
    usual_mm = geometry.gas_lens.find_shift_mm(x_mm, y_mm, sag_mm)
    return lens.find_shift_mm(x_mm, y_mm, sag_mm) - usual_mm


def _form_slopes(unit: FloatArray, radius_mm: float) -> list[FloatArray]:
    """Slopes (2, n) of two saddles and of a round error, at places (2, n) over the radius."""
    x, y = unit
    v = x * x + y * y
    saddle = 2 * _SADDLE_MM / radius_mm * np.stack([x, -y])
    diagonal = 2 * _SADDLE_MM / radius_mm * np.stack([y, x])
    # v (1 - v) is 1/4 at its highest.
    round_error = 4 * _ROUND_MM / radius_mm * 2 * (1 - 2 * v) * np.stack([x, y])
    return [saddle, diagonal, round_error]


def _thickness_slopes(
    unit: FloatArray, cushion: Cushion, front: FrontFilmConfig
) -> list[FloatArray]:
    """Slopes (2, n) of a thickness that changes by its sigma to one side along x, along y, and
    from the middle to the rim.
    """
    x, y = unit
    slope = front.thickness_sigma_relative * cushion.thickness_mm / cushion.radius_mm
    along_x = slope * np.stack([np.ones_like(x), np.zeros_like(x)])
    along_y = slope * np.stack([np.zeros_like(x), np.ones_like(x)])
    outwards = 2 * slope * np.stack([x, y])
    return [along_x, along_y, outwards]
