"""Reports how well the geometry of a run is known, and when it does not fit its cycles."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from membrane_ctrl.geometry.change import describe_change
from membrane_ctrl.geometry.run_geometry import RunGeometry, read_run_geometry
from membrane_ctrl.metrology.cycle.geometry_monitors import DriftMonitor, RingMonitor, noise_urad
from membrane_ctrl.metrology.phase import phase_steps, screen_scale
from membrane_ctrl.metrology.rays.bench_motions import describe_hidden_allowance
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction import slope_noise
from membrane_ctrl.metrology.uncertainty.geometry_statement import (
    GeometryState,
    GeometryStatement,
)
from membrane_ctrl.model import acquisition_events, errors, events, shape_estimate
from membrane_ctrl.run_files.run_config import read_config
from membrane_ctrl.run_files.run_lookup import is_run, is_run_name


def make_geometry_event(
    geometry: RunGeometry, run_dir: Path | None
) -> acquisition_events.GeometryInUse:
    """The event that records the geometry, and what has changed in it since the run before.

    Parameters
    ----------
    geometry : RunGeometry
    run_dir : Path or None
        Folder of the run; the run before is beside it.
    """
    origin = geometry.origin
    event = acquisition_events.GeometryInUse(
        origin.hash, origin.file or None, origin.calibrated_utc or None, geometry.note
    )
    with suppress(OSError, errors.CommandError):  # a damaged run: nothing is stated about it
        before = None if run_dir is None else _find_run_before(run_dir)
        if before is not None:
            former = read_run_geometry(before, read_config(before, []))
            changed = describe_change(former.optics, geometry.optics)
            return replace(event, run_before=before.name, changed=changed or None)
    return event


def _find_run_before(run_dir: Path) -> Path | None:
    """The newest run beside a run that is older; None if it is the first."""
    older = [path for path in run_dir.parent.iterdir() if path.name < run_dir.name]
    runs = (path for path in sorted(older, reverse=True) if is_run_name(path.name) and is_run(path))
    return next(runs, None)


class StatementWatch:
    """Reports how well the geometry is known, when the full cycles' statement changes."""

    def __init__(self) -> None:
        self._state: GeometryState | None = None

    def check_statement(self, statement: GeometryStatement | None) -> events.Event | None:
        """The event of a new state; None if it has not changed, or is not known."""
        if statement is None or statement.state is self._state:
            return None
        self._state = statement.state
        table = statement.table()
        return acquisition_events.GeometryKnown(
            state=table["state"],
            source=table["source"],
            assumed=describe_hidden_allowance(),
            next_step=table["next_step"] or None,
            why="; ".join(statement.doubts) or None,
        )


class GeometryWatch:
    """Compares residual and ring of each cycle with the calibrated ones.

    Parameters
    ----------
    geometry : RunGeometry
        Of the run; without a calibration nothing is compared.
    bin_px : int
        Side of the bins of a live cycle, whose noise the residual contains.
    """

    def __init__(self, geometry: RunGeometry, bin_px: int) -> None:
        optics = geometry.optics
        self._geometry = Geometry.from_config(optics)
        self._radius_mm = optics.mirror.radius_mm
        shifts = phase_steps.equal_shifts(optics.pattern.steps)
        sigma_rad = phase_steps.phase_sigma_rad(
            shifts, slope_noise.pixel_sigma_adu(optics.camera.noise_adu), 1.0
        )
        self._sigma_mm_adu = (
            screen_scale.mm_per_rad(optics.pattern) * sigma_rad / bin_px
        )  # over the modulation
        known = geometry.calibration
        self._monitors: tuple[DriftMonitor, RingMonitor] | None = None
        if known is not None:
            residual = DriftMonitor(known.slope_residual_urad, known.slope_noise_urad)
            self._monitors = residual, RingMonitor(np.array(known.ring_um))
        self._is_reported = False

    def noise_urad(self, estimate: shape_estimate.ShapeEstimate) -> float:
        """The camera noise's share of a cycle's residual."""
        return noise_urad(
            self._geometry,
            self._make_surface(estimate),
            self._sigma_mm_adu / estimate.modulation_median_adu,
        )

    def check_estimate(self, estimate: shape_estimate.ShapeEstimate) -> events.Event | None:
        """Return a notice when a new calibration becomes due, and when it is no longer due."""
        if self._monitors is None or estimate.verdict == "rejected" or estimate.kind == "track":
            return None
        residual, ring = self._monitors
        residual.add(estimate.slope_residual_urad, self.noise_urad(estimate))
        ring.add(self._make_surface(estimate))
        description = ring.description or residual.description
        if bool(description) == self._is_reported:
            return None
        self._is_reported = not self._is_reported
        event_type = events.Maintenance if self._is_reported else events.MaintenanceOver
        return event_type("calibrate", description or "the geometry fits again")

    def _make_surface(self, estimate: shape_estimate.ShapeEstimate) -> Surface:
        return Surface(estimate.coeffs_um / 1e3, estimate.hencky_um / 1e3, self._radius_mm)
