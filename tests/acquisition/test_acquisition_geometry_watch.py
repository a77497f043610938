"""The live cycle's residual against the calibrated one."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.acquisition.geometry_watch import GeometryWatch, make_geometry_event
from membrane_ctrl.config.schema import Config, OpticsConfig
from membrane_ctrl.geometry.file import CalibrationTable, stated_origin
from membrane_ctrl.geometry.run_geometry import RunGeometry, read_run_geometry
from membrane_ctrl.metrology.cycle.geometry_monitors import CYCLES, ring_um
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.run_files.run_folder import create_run_folder

OPTICS = OpticsConfig()
CYCLE = ShapeEstimate(
    time_s=0.0,
    kind="fringes",
    coeffs_um=37_100.0 * zernike_projection(),
    hencky_um=0.0,
    covariance_um2=np.zeros((ZERNIKE_TERMS, ZERNIKE_TERMS)),
    sag_um=37_100.0,
    sag_change_sigma_um=0.1,
    displacement_um=0.0,
    slope_residual_urad=2.9,
    valid_fraction=1.0,
    modulation_median_adu=80.0,
    saturated_fraction=0.0,
    verdict="ok",
)

RING_UM = ring_um(Surface(CYCLE.coeffs_um / 1e3, 0.0, 500.0))
CALIBRATION = CalibrationTable(
    date_utc="2026",
    hash="x",
    slope_residual_urad=3.0,
    slope_noise_urad=1.0,
    ring_um=tuple(RING_UM.tolist()),
)


def in_force(calibration: CalibrationTable | None = CALIBRATION) -> RunGeometry:
    return RunGeometry(OPTICS, stated_origin(OPTICS), calibration)


def test_a_residual_that_has_grown_is_reported_once_and_its_end_too() -> None:
    drift = GeometryWatch(in_force(), 4)
    events = []
    for residual_urad in (2.9, 4.5, 2.9):
        cycle = replace(CYCLE, slope_residual_urad=residual_urad)
        events += [
            event for _ in range(CYCLES) if (event := drift.check_estimate(cycle)) is not None
        ]
    assert [event.kind for event in events] == ["maintenance", "maintenance_over"]
    assert {event.name for event in events} == {"calibrate"}
    assert events[0].message.startswith("calibrate again: the fit leaves 4.50 µrad")


def test_a_ring_that_seems_to_tilt_is_reported_and_a_deeper_bowl_is_not() -> None:
    drift = GeometryWatch(in_force(), 4)
    deeper = replace(CYCLE, coeffs_um=CYCLE.coeffs_um + 2000.0 * zernike_projection())
    assert not any(drift.check_estimate(deeper) for _ in range(CYCLES))
    tilted = CYCLE.coeffs_um.copy()
    tilted[1] += 4.0  # 2 x of the radius a unit: 8 µm at the rim, 5.7 µm RMS around it
    reported = [
        event
        for _ in range(CYCLES)
        if (event := drift.check_estimate(replace(CYCLE, coeffs_um=tilted))) is not None
    ]
    assert [event.name for event in reported] == ["calibrate"]
    assert "the ring is seen 5.7 µm RMS from where it was" in reported[0].message


def test_the_noise_of_weaker_fringes_is_no_drift() -> None:
    weak = GeometryWatch(in_force(), 4)
    # 2.83 µrad of film, and 1.5 µrad of noise that was 1.0 at the calibration and grows as the
    # light fades
    faded = replace(CYCLE, modulation_median_adu=4.0)
    noise_urad = weak.noise_urad(faded)
    assert noise_urad == pytest.approx(20 * weak.noise_urad(CYCLE))
    cycle = replace(faded, slope_residual_urad=float(np.hypot(2.83, noise_urad)))
    assert not any(weak.check_estimate(cycle) for _ in range(2 * CYCLES))


def test_rejected_cycles_and_stated_geometries_report_nothing() -> None:
    rejected = replace(CYCLE, verdict="rejected", slope_residual_urad=900.0)
    drift = GeometryWatch(in_force(), 4)
    assert not any(drift.check_estimate(rejected) for _ in range(2 * CYCLES))
    by_hand = GeometryWatch(in_force(None), 4)
    assert not any(
        by_hand.check_estimate(replace(CYCLE, slope_residual_urad=50.0)) for _ in range(2 * CYCLES)
    )


def test_the_record_names_the_geometry() -> None:
    event = make_geometry_event(in_force(), None)
    assert event.to_dict() == {
        "kind": "geometry",
        "hash": stated_origin(OPTICS).hash,
        "file": None,
        "calibrated_utc": None,
        "message": "",
    }


def _make_run(logs: Path, minute: int, optics: OpticsConfig) -> Path:
    began_utc = datetime(2026, 1, 2, 3, minute, tzinfo=UTC)
    folder = create_run_folder(logs, "lab", began_utc, Config(optics=optics))
    (folder / "events.jsonl").write_text("")
    return folder


def test_the_event_states_what_has_changed_since_the_run_before(tmp_path: Path) -> None:
    moved = OPTICS.geometry.model_copy(update={"a_mm": 2675.5, "a_sigma_mm": 2.0})
    lens = OPTICS.camera.model_copy(update={"principal_px": (1200.0, 1000.0)})
    benches = (
        OPTICS,
        OPTICS,
        OPTICS.model_copy(update={"geometry": moved, "camera": lens}),
        OPTICS,
    )
    messages = []
    for minute, optics in enumerate(benches):
        folder = _make_run(tmp_path, minute, optics)
        (tmp_path / ".remains").mkdir(exist_ok=True)
        geometry = read_run_geometry(folder, Config(optics=optics))
        messages.append(make_geometry_event(geometry, folder).sentence)
    place = "The figures use the geometry of the configuration"
    assert messages[0] == place, "there is no run before"
    assert messages[1] == f"{place}; as in 20260102T030000Z-lab"
    assert messages[2] == (
        f"{place}; changed since 20260102T030100Z-lab: geometry.a_mm from 2672 to 2675.5, "
        "geometry.a_sigma_mm from none to 2, camera.principal_px from (1223.5, 1023.5) to "
        "(1200, 1000)"
    )
    assert "from 2675.5 to 2672" in messages[3]


def test_a_damaged_run_before_is_no_error(tmp_path: Path) -> None:
    before = _make_run(tmp_path, 0, OPTICS)
    (before / "geometry.toml").write_text("not a geometry")
    folder = _make_run(tmp_path, 1, OPTICS)
    event = make_geometry_event(in_force(), folder)
    assert (event.run_before, event.changed) == (None, None)
