"""The `capture.toml` of a simulated set, and the truth beside it."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from membrane_ctrl.config import Section
from membrane_ctrl.twin.simulation_spec import SimulationSpec

FloatArray = NDArray[np.float64]
_GRID = 201  # odd, so that the vertex is a point of the truth's map


def capture_table(spec: SimulationSpec, readings_um: FloatArray) -> dict[str, Any]:
    """The content of `capture.toml` (schema membrane-capture/1).

    Parameters
    ----------
    spec : SimulationSpec
        The set.
    readings_um : (frames,) array
        What the laser said at each frame.
    """
    geometry = _written(spec.stated_geometry or spec.optics.geometry)
    if spec.laser:
        geometry["reference_displacement_um"] = spec.reference_um
    camera = _written(spec.optics.camera)
    if spec.optics.camera.bits == 8:
        del camera["bits"]  # what a reader takes for granted
    camera["principal_px"] = list(spec.optics.camera.principal)
    table: dict[str, Any] = {"schema": "membrane-capture/1", "kind": spec.kind}
    if spec.reference:
        table["reference"] = spec.reference
    table |= {
        "pattern": _written(spec.optics.pattern),
        "geometry": geometry,
        "camera": camera,
        "mirror": _written(spec.optics.mirror),
        "frames": [_frame_row(spec, frame, float(readings_um[frame])) for frame in range(len(spec.patterns))],
    }
    return table


def write_capture_toml(folder: Path, spec: SimulationSpec, readings_um: FloatArray) -> None:
    """Write `capture.toml`."""
    (folder / "capture.toml").write_bytes(tomli_w.dumps(capture_table(spec, readings_um)).encode())


def write_truth(folder: Path, spec: SimulationSpec) -> None:
    """Write what the set was made of.

    `truth.npz`: `x_mm` (W,), `y_mm` (H,), `h_mm` (H, W) above the vertex, NaN outside the rim, at the mean
    displacement of the sinusoids; `h_per_sag` (H, W), its change with sag; `displacement_um` (frames,); `coeffs_um`
    (36,), Noll j = 1..36 with the surface 0 at the vertex, when the 36 terms carry the shape.
    `truth.json`: the same numbers without the maps, and everything that was asked for.
    """
    displacement_um = np.array([spec.displacement_um(frame) for frame in range(len(spec.patterns))])
    fringes = np.array([pattern.role == "sin" for pattern in spec.patterns])
    mean_um = float(displacement_um[fringes].mean())
    coeffs_um = spec.film.coeffs_um(mean_um)
    radius_mm = spec.film.radius_mm
    axis_mm = np.linspace(-radius_mm, radius_mm, _GRID)
    x_mm, y_mm = np.meshgrid(axis_mm, axis_mm)
    inside = x_mm**2 + y_mm**2 <= radius_mm**2
    h_mm = np.where(inside, spec.film.height_mm(x_mm, y_mm, mean_um), np.nan)
    deeper_mm = np.where(inside, spec.film.height_mm(x_mm, y_mm, mean_um + 1000.0), np.nan)
    maps: dict[str, Any] = {"x_mm": axis_mm, "y_mm": axis_mm, "h_mm": h_mm, "h_per_sag": deeper_mm - h_mm}
    if coeffs_um is not None:
        maps["coeffs_um"] = coeffs_um
    np.savez_compressed(folder / "truth.npz", displacement_um=displacement_um, **maps)
    film = {name: value for name, value in asdict(spec.film).items() if name != "terms"}
    truth = {
        "schema": "membrane-simulation/1",
        "displacement_um": mean_um,
        "sag_mm": spec.film.sag_at_mm(mean_um),
        "coeffs_um": None if coeffs_um is None else coeffs_um.tolist(),
        "frame_displacement_um": displacement_um.tolist(),
        "film": film,
        "geometry": _written(spec.optics.geometry) | {"reference_displacement_um": spec.reference_um},
        "light": asdict(spec.light),
        "screen_error": None if spec.screen_error is None else asdict(spec.screen_error),
        "faults": [asdict(fault) for fault in spec.faults],
        "seed": spec.seed,
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=2) + "\n")


def _written(section: Section) -> dict[str, Any]:
    """A configuration table as written: without what is absent, and without lists that are empty."""
    return {key: value for key, value in section.model_dump(mode="json", exclude_none=True).items() if value != []}


def _frame_row(spec: SimulationSpec, frame: int, reading_um: float) -> dict[str, Any]:
    pattern = spec.patterns[frame]
    row: dict[str, Any] = {"file": f"{pattern.name}.png", "role": pattern.role}
    if pattern.axis:
        row |= {"axis": pattern.axis, "index": pattern.index}
    if spec.shifts_rad and pattern.role == "sin":
        row["shift_rad"] = pattern.shift_rad
    row["time_s"] = spec.time_s(frame)
    if spec.laser:
        row["displacement_um"] = reading_um
    return row
