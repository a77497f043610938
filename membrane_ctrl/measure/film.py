"""The `film` command: the film's material from capture sets at several pressures."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.geometry import file, spread_file
from membrane_ctrl.measure.measurement import Figures, SetFigure
from membrane_ctrl.measure.result_files import write_json, write_picture
from membrane_ctrl.metrology.film import film_figure, material_fit, orthotropy, ring_waves
from membrane_ctrl.metrology.film.film_law import FilmLaw
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.uncertainty import linear_covariance
from membrane_ctrl.model import errors, files, program, terminal
from membrane_ctrl.model.arrays import FloatArray

# The paper's film, to which an unknown one is compared.
_STIFFNESS_N_PER_M = 2.05e5
_POISSON = 0.3
_PRESSURE_PA = 600.0
_PAPER_EDGE_MM = 3.0
_SURELY_SHARED = 0.99  # probability beyond which a shared figure is stated as the cause
_TOGETHER = 0.98  # correlation of two numbers that the sets determine only together
_UNLIKE_LAW = 0.5  # share of the departure from Hencky that the law leaves: another law
_SURELY_LEFT = 3.0  # sigmas beyond which the law leaves something
_PROFILE_POINTS = 96
_PROFILE_ANGLES = 16
# Unit and factor of the amounts of waves, where it is not mm.
_WAVE_UNITS = {"prestrain": ("µm/m", 1e6), "modulus": ("%", 100.0), "shear": ("%", 100.0)}
_OF_FILM = ("modulus", "shear")  # causes of the film; others are the ring's
# Of each term, if nothing of the mirror is seen: a fit over part of the disc takes what the terms
# cannot represent for other terms. 18 nm were found where 67 % is seen.
_HIDDEN_MM = 3e-5
_CAUSES: dict[str, str] = {
    "prestrain": "pre-strain varies",
    "flat": "ring not flat",
    "round": "ring not round",
    "modulus": "film stiffer in one direction",
    "shear": "shear modulus not that of an isotropic film",
}


@dataclass(frozen=True)
class FilmOptions:
    """Options of the command."""

    folders: tuple[Path, ...]
    geometry: Path | None
    gauge: material_fit.Gauge
    out: Path | None
    as_json: bool
    pictures: bool


@dataclass(frozen=True)
class _Departure:
    """Departure of the sets' profiles from Hencky's law and from the fitted one.

    Attributes
    ----------
    radius_mm : (points,) array
        Where the profiles are known.
    from_hencky_mm : (n, points) array
        Profiles less those of the paper's film without pre-strain.
    left_mm : (n, points) array
        What the fitted law leaves of the profiles.
    sigma_mm : (n, points) array
        Standard uncertainty of a profile from noise, geometry and the law's misfit.
    """

    radius_mm: FloatArray
    from_hencky_mm: FloatArray
    left_mm: FloatArray
    sigma_mm: FloatArray

    @property
    def from_hencky_um(self) -> float:
        """RMS of `from_hencky_mm` over the area."""
        return self._rms_um(self.from_hencky_mm)

    @property
    def left_um(self) -> float:
        """RMS of `left_mm` over the area."""
        return self._rms_um(self.left_mm)

    @property
    def sigma_um(self) -> float:
        """Standard uncertainty of `left_um`."""
        return self._rms_um(self.sigma_mm)

    @property
    def contradicts(self) -> bool:
        """Whether the law leaves most of the departure, beyond doubt."""
        is_significant = self.left_um > _SURELY_LEFT * self.sigma_um
        return is_significant and self.left_um > _UNLIKE_LAW * self.from_hencky_um

    def _rms_um(self, profiles_mm: FloatArray) -> float:
        share = self.radius_mm / np.sum(self.radius_mm)
        return 1e3 * float(np.sqrt(np.mean(np.sum(share * profiles_mm**2, axis=1))))


def film_command(options: FilmOptions) -> int:
    """Fit the law to the sets, write the result and report it. Raises CommandError."""
    measured = Figures(None if options.geometry is None else file.read_geometry(options.geometry))

    # The sets' figures, all of one film.
    sets = [
        measured.measure_folder(folder)
        for folder in terminal.track_progress(options.folders, "sets")
    ]
    mirror = sets[0].head.optics.mirror
    for one in sets:
        if one.head.artefact is not None:
            raise errors.InputError(
                f"{one.head.folder / 'capture.toml'}: artefact: a set of no film"
            )
        if one.head.optics.mirror.radius_mm != mirror.radius_mm:
            raise errors.InputError(
                f"{one.head.folder / 'capture.toml'}: mirror.radius_mm: not that of the first set"
            )

    # The film's material, and what it does not explain.
    figures, source = _read_figures(sets, options.geometry)
    try:
        fit = material_fit.fit_film(
            figures, mirror.radius_mm, mirror.analysis_radius_mm, options.gauge
        )
    except ValueError as error:
        raise errors.RejectedError(f"film: {error}") from None
    departure = _compute_departure(figures, fit, mirror.analysis_radius_mm)
    notes = _list_limits(figures, fit, departure)
    table = _make_fit_table(figures, fit, departure, source, notes)

    # Files and the text for the terminal.
    out = options.out.resolve() if options.out else options.folders[0].resolve().parent / "film"
    with errors.convert_write_errors(out):
        files.make_folder(out)
        write_json(out / "film.json", table)
        if options.pictures:
            _draw_fit(out / "film.png", figures, fit, departure)
    print(f"written to {out}", file=sys.stderr)
    print(json.dumps(table) if options.as_json else "\n".join(_format_fit(table, figures)))
    return 0


def _read_figures(
    sets: list[SetFigure], geometry: Path | None
) -> tuple[list[film_figure.FilmFigure], str]:
    """The sets' figures with their errors, and where the geometry's spread comes from."""
    spread, source = spread_file.geometry_spread(sets[0].head.optics, geometry)
    out = []
    for one in sets:
        bench = one.make_trial_bench()
        surface = one.figure.fit.surface
        noise_mm2 = linear_covariance.noise_covariance(bench)
        # The law's terms are those of a fit over the whole disc.
        hidden_mm = _HIDDEN_MM * (1 - one.figure.quality.valid_fraction)
        noise_mm2 = noise_mm2 + hidden_mm**2 * np.eye(len(noise_mm2))
        geometry_mm = linear_covariance.geometry_jacobian(bench, spread) @ spread.covariance_root()
        figure = film_figure.FilmFigure(
            one.head.folder.name,
            surface.parameters,
            noise_mm2,
            geometry_mm,
            one.head.pressure_pa,
            surface.sag_mm,
        )
        out.append(figure)
    return out, source


def _compute_departure(
    figures: list[film_figure.FilmFigure], fit: material_fit.FilmFit, reach_mm: float
) -> _Departure:
    """The departure of the figures up to a radius."""
    disc_mm = fit.law.radius_mm
    radius_mm = np.linspace(0.0, reach_mm, _PROFILE_POINTS)
    rho = radius_mm / disc_mm
    paper = FilmLaw(0.0, _POISSON, _STIFFNESS_N_PER_M, disc_mm)
    from_hencky_mm = []
    left_mm = []
    for figure, left in zip(figures, fit.left_mm, strict=True):
        # Hencky's bowl of the same pressure, or of the same sag if no gauge was read.
        if np.isfinite(figure.pressure_pa):
            hencky = paper.under_pressure(figure.pressure_pa)
        else:
            hencky = paper.with_sag(figure.sag_mm)
        measured_mm = _profile_mm(figure.parameters_mm, disc_mm, radius_mm)
        from_hencky_mm.append(measured_mm - hencky.height_mm(rho))
        left_mm.append(_profile_mm(left, disc_mm, radius_mm))
    sigma_mm = np.array([_profile_sigma_mm(figure, fit, rho) for figure in figures])
    return _Departure(radius_mm, np.array(from_hencky_mm), np.array(left_mm), sigma_mm)


def _profile_sigma_mm(
    figure: film_figure.FilmFigure, fit: material_fit.FilmFit, rho: FloatArray
) -> FloatArray:
    """Sigma (points,) of a round profile: noise, geometry, and the law's misfit."""
    disc_mm = fit.law.radius_mm
    # Profile of 1 mm of each parameter.
    units = np.eye(figure.parameters_mm.size)
    profiles = np.stack([_profile_mm(unit, disc_mm, rho * disc_mm) for unit in units])
    misfit_mm = 1e-3 * fit.misfit_um * np.sqrt(np.sum(profiles[material_fit.ROUND] ** 2, axis=0))
    noise_mm2 = np.einsum("ip,ij,jp->p", profiles, figure.noise_mm2, profiles)
    geometry_mm2 = np.sum((profiles.T @ figure.geometry_mm) ** 2, axis=1)
    return np.asarray(np.sqrt(noise_mm2 + geometry_mm2 + misfit_mm**2))


def _profile_mm(parameters_mm: FloatArray, radius_mm: float, at_mm: FloatArray) -> FloatArray:
    """The rotationally symmetric part of a figure's height."""
    angle = 2 * np.pi * np.arange(_PROFILE_ANGLES)[:, None] / _PROFILE_ANGLES
    surface = Surface.from_parameters(parameters_mm, radius_mm)
    return np.asarray(surface.height(at_mm * np.cos(angle), at_mm * np.sin(angle)).mean(axis=0))


def _list_limits(
    figures: list[film_figure.FilmFigure], fit: material_fit.FilmFit, departure: _Departure
) -> list[str]:
    """What these sets cannot determine, in words."""
    gauged = [figure.pressure_pa for figure in figures if np.isfinite(figure.pressure_pa)]
    notes = [
        f"{_count_waves(waves.order)} of {waves.rms_um:.3g} µm RMS, cause unknown; it looks like "
        + " or ".join(_CAUSES[cause] for cause in waves.likely[:2])
        for waves in fit.unexplained
    ]
    notes += [_describe_shared(waves) for waves in fit.shared]

    # What the sets do not determine.
    if not gauged:
        notes.append(
            "E t is not determined: no set states pressure_pa; pre-strain and nu need none"
        )
    strain, poisson, _ = fit.sigmas
    if strain > material_fit.PRESTRAIN_SIGMA / 2:
        notes.append("the pre-strain is not determined: its bar is what was known before")
    if poisson > material_fit.POISSON_SIGMA / 2:
        notes.append(
            "nu is not determined: its bar is what was known before; take sets at other pressures"
        )

    # Elastic constants by direction
    if fit.orthotropy is None:
        notes.append("E1, E2 and G12 are not determined: waves of two or four have another cause")
    elif fit.orthotropy.has_other_axes:
        notes.append(
            "the four waves are not along the axes of the two: no orthotropic film has such"
        )

    # What they determine only together.
    notes += [_describe_together(pair) for pair in fit.together]
    together = fit.covariance[0, 1] / (strain * poisson)
    if abs(together) > _TOGETHER:
        sags = [figure.sag_mm for figure in figures]
        notes.append(
            f"pre-strain and nu are known only together (correlation {together:+.3f}): the "
            f"sags, {min(sags):.1f} to "
            f"{max(sags):.1f} mm, are too close"
        )

    # What contradicts the law.
    if departure.contradicts:
        notes.append(
            "the film departs from this law: it crept between the sets, its ring moved, or "
            "it is not elastic"
        )
    return notes


def _count_waves(order: int) -> str:
    """Waves around the ring, in words."""
    if order == 1:
        return "1 wave"
    return f"{order} waves"


def _describe_shared(waves: ring_waves.SharedWaves) -> str:
    """Waves that may be the same in all sets."""
    text = f"{_count_waves(waves.order)} of {waves.rms_um:.3g} µm RMS, "
    elsewhere = "the lens, the mount, the geometry or the ring"
    if waves.weight > _SURELY_SHARED:
        return text + f"the same at all sags: not the film's; of {elsewhere}"
    causes = " or ".join(_CAUSES[cause] for cause in waves.likely[:2])
    return text + (
        f"of no sure cause: a figure that all sets share ({elsewhere}), by a probability of "
        f"{waves.weight:.0%}, or {causes}"
    )


def _describe_together(pair: ring_waves.CausesTogether) -> str:
    """Which combination of two causes of waves the sets determine."""
    first, second = pair.causes
    unit, scale = _WAVE_UNITS.get(first, ("mm", 1.0))
    other_unit, other_scale = _WAVE_UNITS.get(second, ("mm", 1.0))
    factor = pair.factor * scale / other_scale
    sign = "+"
    if factor > 0:
        sign = "-"
    waves = _count_waves(pair.order)
    return (
        f"{_CAUSES[first]} and {_CAUSES[second]}, {waves}, are known only together "
        f"(correlation {pair.correlation:+.3f}): the first {sign} {abs(factor):.3g} {unit} per "
        f"{other_unit} of the second is known to {scale * pair.sigma:.2g} {unit}"
    )


def _make_constants(film: orthotropy.OrthotropicFilm | None, gauged: bool) -> dict[str, Any] | None:
    """Elastic constants by direction, for `film.json`; those of a stiffness need a gauge."""
    if film is None:
        return None
    sigmas = film.sigmas
    table: dict[str, Any] = {
        name: {"value": float(value), "sigma": float(sigma)}
        for name, value, sigma in zip(orthotropy.CONSTANTS, film.values, sigmas, strict=True)
        if gauged or not name.endswith("_n_per_m")
    }
    direction = None
    if film.has_direction:
        direction = {
            "value": float(np.degrees(film.direction_rad)),
            "sigma": float(np.degrees(film.direction_sigma_rad)),
        }
    table["direction_deg"] = direction
    return table


def _list_constants(table: dict[str, Any] | None) -> list[str]:
    """Elastic constants by direction as lines of text."""
    if table is None:
        return []
    # Ratios are known without a gauge; moduli only with one.
    ratio = table["ratio"]
    shear = table["g12_over_e1"]
    direction = "no stiff direction is seen"
    if table["direction_deg"] is not None:
        found = table["direction_deg"]
        direction = f"stiff along {found['value']:.1f} +- {found['sigma']:.2g} degrees"
    lines = [f"E1 / E2    {ratio['value']:.4f} +- {ratio['sigma']:.2g}; {direction}"]
    if "e1_n_per_m" in table:
        moduli = [
            f"{label} {table[name]['value'] / 1e3:.2f} +- {table[name]['sigma'] / 1e3:.2g}"
            for label, name in (
                ("E1 t", "e1_n_per_m"),
                ("E2 t", "e2_n_per_m"),
                ("G12 t", "g12_n_per_m"),
            )
        ]
        lines.append(f"moduli     {', '.join(moduli)} kN/m")
    lines.append(
        f"nu12       {table['nu12']['value']:.4f} +- {table['nu12']['sigma']:.2g}; G12 / E1 "
        f"{shear['value']:.4f} +- {shear['sigma']:.2g}"
    )
    return lines


def _make_fit_table(
    figures: list[film_figure.FilmFigure],
    fit: material_fit.FilmFit,
    departure: _Departure,
    source: str,
    notes: list[str],
) -> dict[str, Any]:
    """The content of `film.json`."""
    law = fit.law
    # The stiffness of the fit is relative: its sigma is a share.
    strain, poisson, relative = fit.sigmas
    gauged = any(np.isfinite(figure.pressure_pa) for figure in figures)
    edge = [float(profile[-1]) for profile in departure.from_hencky_mm]

    # Without a pressure the stiffness has no meaning; the paper's then serves for the pre-strain
    # that would explain its edge.
    stiffness = None
    stiffness_n_per_m: FloatArray | float = _STIFFNESS_N_PER_M
    if gauged:
        stiffness_n_per_m = law.stiffness_n_per_m
        stiffness = {
            "value": law.stiffness_n_per_m,
            "sigma": float(relative) * float(law.stiffness_n_per_m),
        }

    # The table of `film.json`.
    return {
        **program.file_origin("membrane-film/1"),
        "sets": [
            {
                "set": figure.name,
                "sag_mm": figure.sag_mm,
                "pressure_pa": figure.pressure_pa if np.isfinite(figure.pressure_pa) else None,
                "edge_from_hencky_mm": at_edge,
                "left_rms_um": 1e3 * float(np.sqrt(np.sum(left**2))),
            }
            for figure, at_edge, left in zip(figures, edge, fit.left_mm, strict=True)
        ],
        "prestrain": {"value": law.prestrain, "sigma": float(strain)},
        "poisson": {"value": law.poisson, "sigma": float(poisson)},
        "stiffness_n_per_m": stiffness,
        "orthotropy": _make_constants(fit.orthotropy, gauged),
        "covariance": fit.covariance.tolist(),  # of pre-strain, nu, relative stiffness
        "ring": [
            {
                "cause": wave.cause,
                "order": wave.order,
                "cos_sin": wave.amounts.tolist(),
                "sigmas": wave.sigmas.tolist(),
            }
            for wave in fit.waves
            if wave.is_sure
        ],
        "misfit_um": fit.misfit_um,
        "departure": {
            "rms_um": departure.from_hencky_um,
            "left_um": departure.left_um,
            "left_sigma_um": departure.sigma_um,
        },
        "paper_prestrain": _paper_prestrain(float(law.poisson), stiffness_n_per_m),
        "geometry": source,
        "notes": notes,
    }


def _paper_prestrain(poisson: float, stiffness: FloatArray | float) -> float:
    """The pre-strain that makes this film 3 mm less deep than the paper's Hencky film at 600 Pa."""
    # Sag by pre-strain, in steps that a straight line joins.
    strains = np.linspace(-2e-4, 5e-3, 200)
    hencky = FilmLaw(0.0, _POISSON, _STIFFNESS_N_PER_M, 500.0).under_pressure(_PRESSURE_PA)
    sags = (
        FilmLaw(strains[:, None], poisson, stiffness, 500.0)
        .under_pressure(_PRESSURE_PA)
        .sag_mm.ravel()
    )
    return float(np.interp(_PAPER_EDGE_MM, float(hencky.sag_mm) - sags, strains))


def _format_fit(table: dict[str, Any], figures: list[film_figure.FilmFigure]) -> list[str]:
    """The result as lines of text."""
    # What determines the law, then its constants.
    strain = table["prestrain"]
    poisson = table["poisson"]
    stiffness = table["stiffness_n_per_m"]
    sags = [figure.sag_mm for figure in figures]
    lines = [
        f"sets       {len(figures)}, sag {min(sags):.2f} to {max(sags):.2f} mm; geometry: "
        f"{table['geometry']}",
        f"pre-strain {1e6 * strain['value']:.1f} +- {1e6 * strain['sigma']:.2g} µm/m",
        f"nu         {poisson['value']:.4f} +- {poisson['sigma']:.2g}",
    ]
    if stiffness is not None:
        lines.append(
            f"E t        {stiffness['value'] / 1e3:.2f} +- {stiffness['sigma'] / 1e3:.2g} kN/m"
        )
    lines += _list_constants(table["orthotropy"])
    lines += [_wave_line(wave) for wave in table["ring"]]

    # The departure from the paper's film, and what the law leaves of it.
    edges = [one["edge_from_hencky_mm"] for one in table["sets"]]
    departure = table["departure"]
    return [
        *lines,
        f"Hencky     the measured edge is {min(edges):+.3f} to {max(edges):+.3f} mm from "
        "Hencky's film of 205 kN/m, "
        f"nu 0.3: {departure['rms_um']:.3g} µm RMS, of which the law leaves "
        f"{departure['left_um']:.2g} (1 sigma {departure['left_sigma_um']:.2g})",
        f"misfit     {table['misfit_um']:.3g} µm a term that no law explains; it is in the bars",
        f"paper      its 3 mm would be a pre-strain of {1e6 * table['paper_prestrain']:.0f} "
        "µm/m in this film",
        *(f"note       {note}" for note in table["notes"]),
    ]


def _wave_line(wave: dict[str, Any]) -> str:
    """Amount of one cause of waves, and its direction if it is the film's."""
    kind = wave["cause"]
    cosine, sine = wave["cos_sin"]
    unit, scale = _WAVE_UNITS.get(kind, ("mm", 1.0))
    amount = scale * np.hypot(cosine, sine)
    sigma = scale * max(wave["sigmas"])
    origin = "ring"
    if kind in _OF_FILM:
        origin = "film"
    along = ""
    if kind == "modulus":
        along = f", along {np.degrees(np.arctan2(sine, cosine)) / 2 % 180:.0f} degrees"
    return (
        f"{origin:<11}{_CAUSES[kind]}, {_count_waves(wave['order'])}: {amount:.3g} +- {sigma:.2g} "
        f"{unit}{along}"
    )


def _draw_fit(
    path: Path,
    figures: list[film_figure.FilmFigure],
    fit: material_fit.FilmFit,
    departure: _Departure,
) -> None:
    """Draw the departures, and the error ellipse of pre-strain and Poisson ratio."""
    from matplotlib.figure import Figure

    # Departures from Hencky's film, and what the law leaves of them.
    drawing = Figure(figsize=(13, 4.2), layout="constrained")
    seen, left, both = drawing.subplots(1, 3)
    for figure, profile, rest in zip(
        figures, departure.from_hencky_mm, departure.left_mm, strict=True
    ):
        seen.plot(departure.radius_mm, profile, label=f"{figure.name}, {figure.sag_mm:.1f} mm")
        left.plot(departure.radius_mm, 1e3 * rest)
    seen.set(title="less Hencky's film of the paper", xlabel="radius (mm)", ylabel="mm")
    left.set(
        title=f"less the law ({departure.left_um:.2g} µm RMS left)",
        xlabel="radius (mm)",
        ylabel="µm",
    )
    seen.legend(fontsize=8)

    # Error ellipses: a circle, stretched by the root of the covariance.
    angle = np.linspace(0, 2 * np.pi, 181)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    root = np.linalg.cholesky(fit.covariance[:2, :2])
    centre = np.array([fit.law.prestrain, fit.law.poisson], float)
    for sigmas in (1, 2):
        strain, poisson = centre[:, None] + sigmas * root @ circle
        both.plot(1e6 * strain, poisson, label=f"{sigmas} sigma")
    both.plot(1e6 * centre[0], centre[1], "+", color="black")
    both.set(title="pre-strain and Poisson ratio", xlabel="pre-strain (µm/m)", ylabel="nu")
    both.legend(fontsize=8)
    write_picture(path, drawing)
