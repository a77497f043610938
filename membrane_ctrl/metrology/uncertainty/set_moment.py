"""The moment that a set's sag holds for, while the film moves and no laser reads its place.

The figure is that of the mean of the sinusoids. A film that drifts is elsewhere on average over the
whole set, or at its middle. The fringes of each axis show how the film moves from one frame to the
next: a drift that both axes have is continued over the set, and of what is left, half is assumed to
differ between the sinusoids and the other frames. A step between the axes leaves no trace here; by
the sinusoids' mean the sag is right then, too.

With a laser the figure holds for the mean of all its readings. Where a frame is left out, only the
readings show how far the film was from there in the other frames, and their noise remains.
"""

import math

import numpy as np

from membrane_ctrl.metrology.figure.set_motion import LASER_NOISE_UM, FilmMotion
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.model.arrays import FloatArray

_UNEVEN_SHARE = 0.5  # of an uneven motion within the axes: 0.15 to 0.4 of it for steps and swings


def moment_sigma_um(
    frames: tuple[FloatArray, FloatArray], film_um: FloatArray, noise_um: float, count_frames: int
) -> float:
    """1 sigma of the film's mean place over a set, about that over the sinusoids.

    Parameters
    ----------
    frames : two arrays
        Numbers of the used sinusoids of x and of y in the set.
    film_um : (n,) array
        The film's places at these frames, each axis about its own mean.
    noise_um : float
        1 sigma of each place.
    count_frames : int
        Of the set.
    """
    rates_um, rate_sigma_um = [], 0.0
    centred = []
    for numbers, places_um in zip(frames, np.split(film_um, [len(frames[0])]), strict=True):
        from_middle = numbers - numbers.mean()
        square = float(from_middle @ from_middle)
        rates_um.append(float(from_middle @ places_um) / square)
        rate_sigma_um = max(rate_sigma_um, noise_um / math.sqrt(square))
        centred.append((from_middle, places_um - places_um.mean()))
    # A drift is the same in both axes. A step within one of them is none.
    agree = rates_um[0] * rates_um[1] > 0
    drift_um = min(rates_um, key=abs) if agree else 0.0
    left_um = np.concatenate([places - drift_um * numbers for numbers, places in centred])
    uneven_um = math.sqrt(max(float(np.mean(left_um**2)) - noise_um**2, 0.0))
    later = (count_frames - 1) / 2 - float(np.concatenate(frames).mean())
    return math.hypot(later * drift_um, later * rate_sigma_um, _UNEVEN_SHARE * uneven_um)


def left_out_sigma_um(used: int, shown: int, laser_noise_um: float) -> float:
    """1 sigma of the mean reading of the used sinusoids about that of all that were shown."""
    return laser_noise_um * math.sqrt(1 / used - 1 / shown)


def moment_source(checked: Checked, film: FilmMotion, radius_mm: float) -> Source | None:
    """The row of the budget; None with a laser, unless the film moved and a frame is left out."""
    used = [np.array(frames, float) for frames in checked.view.used]
    stack = checked.stack
    if math.isfinite(film.x_to_y_sigma_um):
        count_used = sum(frames.size for frames in used)
        if not film.worth_correcting or count_used == stack.readings_um.size:
            return None
        sigma_um = left_out_sigma_um(count_used, stack.readings_um.size, LASER_NOISE_UM)
        says = "the laser's noise where a frame is left out while the film moves"
    else:
        frames = used[0], used[1]
        count_frames = len(stack.patterns)
        sigma_um = moment_sigma_um(frames, checked.film_um, checked.film_noise_um, count_frames)
        says = "motion of the film during the set, without a laser"
    deeper_mm = Surface.hencky_bowl(1e-3 * sigma_um, radius_mm).parameters
    return Source("moment_um", says, sigma_um, deeper_mm[:, None], common=False, paired=False)
