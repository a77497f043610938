"""The figure of one set, as the fit of a film's material needs it."""

from dataclasses import dataclass

from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class FilmFigure:
    """One set's figure."""

    name: str
    parameters_mm: FloatArray  # (parameters,), as of `Surface.parameters`
    noise_mm2: FloatArray  # (parameters, parameters): covariance from the pixels' noise
    # (parameters, k): change with each independent error of the geometry by its sigma
    geometry_mm: FloatArray
    pressure_pa: float  # NaN without a gauge
    sag_mm: float
