"""The light of one frame as a sum of known columns, and the fit of their coefficients.

For a sinusoid with predicted phase psi = phi + d_k

    I = g [m + b cos(psi + delta) + c2 cos 2 psi + c3 cos 3 psi + c4 cos 4 psi
           - b e (q - <q>) sin psi]

with g the bin's light and q its known change of phase per µm of film motion: linear in m, b cos
delta, b sin delta, b e, c2, c3 and c4. The harmonics are the display's response, the same in all
frames. A Gray frame has two levels, I = g (lo + (hi - lo) bit); white and black have one.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.frame_checks.sampled_bins import SampledBins
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import BoolArray, FloatArray

_TINY = 1e-9  # instead of a division by zero
COSINE, SINE, MOTION, SECOND_HARMONIC = range(1, 5)  # columns of a sinusoid's model
# Distance from a Gray bit's edge, rad: blur, and the film's motion by up to some hundred µm, stay
# inside.
_EDGE_RAD = 0.5
_HARMONICS = (2, 3, 4)  # of a sinusoid: the display's response


@dataclass(frozen=True)
class FrameModel:
    """What a frame is a sum of: the equations of the module's docstring, as columns.

    Attributes
    ----------
    role : str
        "sin", "gray", "white" or "black".
    columns : (p, n) array
        In units of the light. Of a sinusoid: 1, cos psi, -sin psi, -(q - <q>) sin psi, harmonics.
    sure : (n,) bool array
        Bins to compare on.
    """

    role: str
    columns: FloatArray
    sure: BoolArray

    def wave(self) -> tuple[BoolArray, FloatArray]:
        """Return the pattern that the frame should show, scaled for correlations.

        Returns
        -------
        sure : (n,) bool array
            Bins to compare on.
        wave : (m,) array
            The pattern on these m bins; its product with a picture of standard deviation 1 is
            their correlation.
        """
        # The second column; white and black have the constant alone.
        shape = self.columns[min(1, len(self.columns) - 1)]
        pattern = shape[self.sure]
        norm = pattern.size * max(pattern.std(), 1e-6)
        return self.sure, (pattern - pattern.mean()) / norm


def make_frame_model(
    stack: FrameStack, scene: SampledBins, frame: int, reading_um: float
) -> FrameModel:
    """Make the model of one frame.

    Parameters
    ----------
    stack : FrameStack
        The set, with the pattern of each frame.
    scene : SampledBins
        Bins with their predicted phases.
    frame : int
        Number of the frame.
    reading_um : float
        What the laser read during the frame more than in the mean of the set.

    Returns
    -------
    FrameModel
    """
    pattern = stack.patterns[frame]
    ones = np.ones(scene.index.size)
    every_bin = ones.astype(bool)

    # White and black: one level.
    if pattern.role in ("white", "black"):
        return FrameModel(pattern.role, ones[None], every_bin)

    # The phase during this frame: the predicted one, moved with the film.
    axis = AXES.index(pattern.axis)
    sensitivity = scene.sensitivity_rad_per_um[axis]
    phase_rad = scene.phase_rad[axis] + sensitivity * reading_um

    # A Gray frame: two levels, away from the edges of its bit.
    if pattern.role == "gray":
        shown, from_edge_rad = gray_bit(phase_rad, pattern.index)
        sure = from_edge_rad > _EDGE_RAD
        if not sure.any():  # edges everywhere: the prediction is nonsense, and all bins are used
            sure = every_bin
        return FrameModel("gray", np.stack([ones, shown.astype(float)]), sure)

    # A sinusoid: level, fundamental, motion of the film, and harmonics of the display.
    psi_rad = phase_rad + pattern.shift_rad
    sine = np.sin(psi_rad)
    motion = -(sensitivity - sensitivity.mean()) * sine
    harmonics = [np.cos(k * psi_rad) for k in _HARMONICS]
    columns = np.stack([ones, np.cos(psi_rad), -sine, motion, *harmonics])
    return FrameModel("sin", columns, every_bin)


@dataclass(frozen=True)
class FrameSolution:
    """The least squares of a frame by its model, on its n sure bins.

    Attributes
    ----------
    coefficients : (p,) array
        Of the model's columns.
    columns : (p, n) array
        Those columns, times the light.
    inverse : (p, p) array
        Inverse of the normal matrix.
    rest : (n,) array
        What the model leaves.
    """

    coefficients: FloatArray
    columns: FloatArray
    inverse: FloatArray
    rest: FloatArray

    @property
    def rest_rms(self) -> float:
        """RMS of what the model leaves, which is the noise of each bin."""
        return float(np.sqrt(np.mean(self.rest**2)))

    @property
    def swing(self) -> float:
        """Swing b of a sinusoid, by b cos delta and b sin delta."""
        return float(np.hypot(self.coefficients[COSINE], self.coefficients[SINE]))

    @property
    def second_harmonic(self) -> float:
        """Size of the second harmonic of a sinusoid, over its swing."""
        return abs(float(self.coefficients[SECOND_HARMONIC])) / max(self.swing, _TINY)


def solve_frame(seen: FloatArray, model: FrameModel, light: FloatArray) -> FrameSolution:
    """Fit the coefficients of a model to the light of a frame, by least squares on its sure bins.

    Parameters
    ----------
    seen : (m,) array
        Light of all bins in the frame.
    model : FrameModel
        What the frame is a sum of.
    light : (m,) array
        Light by which the model's columns are multiplied.

    Returns
    -------
    FrameSolution
    """
    # Normal equations, scaled to a unit diagonal: the columns are of very different size.
    sure = model.sure
    columns = (model.columns * light)[:, sure]
    normal = columns @ columns.T
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    scales = np.outer(scale, scale)
    inverse = np.linalg.pinv(normal / scales) / scales
    solved = inverse @ (columns @ seen[sure])
    return FrameSolution(solved, columns, inverse, seen[sure] - solved @ columns)
