"""The moment that a set's sag holds for, while the film moves and no laser reads its place.

The figure is that of the mean of the sinusoids. A film that drifts is elsewhere on average over the
whole set, or at its middle. The fringes of each axis show how the film moves from one frame to the
next: a drift that both axes have is continued over the set, and of what is left, half is assumed to
differ between the sinusoids and the other frames. A step between the axes leaves no trace in either
of them, but the slopes in x of one bowl and in y of another do not belong together
(`unseen_motion`): what they show beyond the drift and beyond their own sigma may have happened at
any time between the two.

With a laser the figure holds for the mean of all its readings. Where a frame is left out, only the
readings show how far the film was from there in the other frames, and their noise remains.
"""

import math

import numpy as np

from membrane_ctrl.metrology.figure.set_motion import LASER_NOISE_UM, FilmMotion
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.unseen_motion import UnseenMotion
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
    # The scatter about an even drift, and how well each axis shows the drift.
    rate_um = drift_um(frames, film_um)
    rate_sigma_um = 0.0
    left = []
    for numbers, places_um in zip(frames, np.split(film_um, [len(frames[0])]), strict=True):
        from_middle = numbers - numbers.mean()
        square = float(from_middle @ from_middle)
        rate_sigma_um = max(rate_sigma_um, noise_um / math.sqrt(square))
        left.append(places_um - places_um.mean() - rate_um * from_middle)

    # Motion beyond drift and noise.
    mean_square_um2 = float(np.mean(np.concatenate(left) ** 2))
    uneven_um = math.sqrt(max(mean_square_um2 - noise_um**2, 0.0))

    # The mean of the sinusoids is this many frames before the middle of the set.
    later = (count_frames - 1) / 2 - float(np.concatenate(frames).mean())
    return math.hypot(later * rate_um, later * rate_sigma_um, _UNEVEN_SHARE * uneven_um)


def drift_um(frames: tuple[FloatArray, FloatArray], film_um: FloatArray) -> float:
    """Drift of the film from one frame to the next, as the fringes show it.

    A drift is the same in both axes. A step within one of them is none.

    Parameters
    ----------
    frames : two arrays
        Numbers of the used sinusoids of x and of y in the set.
    film_um : (used,) array
        Displacement of the film during them, first x.

    Returns
    -------
    float
        µm a frame; the smaller of both axes, 0 if their signs differ.
    """
    rates_um = []
    for numbers, places_um in zip(frames, np.split(film_um, [len(frames[0])]), strict=True):
        from_middle = numbers - numbers.mean()
        rates_um.append(float(from_middle @ places_um) / float(from_middle @ from_middle))
    if rates_um[0] * rates_um[1] > 0:
        return min(rates_um, key=abs)
    return 0.0


def step_sigma_um(
    frames: tuple[FloatArray, FloatArray], step_um: float, sigma_um: float, count_frames: int
) -> float:
    """1 sigma of the film's mean place over a set, about that over the sinusoids, after a step.

    Parameters
    ----------
    frames : two arrays
        Numbers of the used sinusoids of x and of y in the set.
    step_um, sigma_um : float
        Motion from x to y beyond a drift, as the fringes show it, with its sigma.
    count_frames : int
        Of the set.
    """
    # The step beyond its own noise.
    true_um = math.sqrt(max(step_um**2 - sigma_um**2, 0.0))

    # Share of the set's frames after the step, if it was directly before or directly after the
    # frames between the two axes; less that of the sinusoids.
    before, after = sorted(frames, key=lambda numbers: float(numbers.mean()))
    shares = 1 - np.array([before.max() + 1, after.min()]) / count_frames
    share_of_sinusoids = after.size / (before.size + after.size)
    away = shares - share_of_sinusoids

    # Mean square over all times in between, which are equally likely.
    middle = float(np.mean(away))
    width = float(np.ptp(away))
    return true_um * math.sqrt(middle**2 + width**2 / 12)


def left_out_sigma_um(used: int, shown: int, laser_noise_um: float) -> float:
    """Return 1 sigma of the mean reading of the used sinusoids about that of all that were shown.

    Parameters
    ----------
    used, shown : int
        Number of sinusoids.
    laser_noise_um : float
        Noise of a reading.
    """
    return laser_noise_um * math.sqrt(1 / used - 1 / shown)


def moment_source(
    checked: Checked, film: FilmMotion, seen: UnseenMotion | None, radius_mm: float
) -> Source | None:
    """Return the row for a figure whose moment is not the mean moment of the set.

    Section 3 of docs/explanation/uncertainty.md.

    Parameters
    ----------
    checked : Checked
        The set.
    film : FilmMotion
        Motion of the film by laser and fringes.
    seen : UnseenMotion or None
        Motion from x to y as the fringes show it, of a set without a laser.
    radius_mm : float
        Radius of the mirror.

    Returns
    -------
    Source or None
        None with a laser, unless the film moved and a frame is left out.
    """
    used = [np.array(frames, float) for frames in checked.view.used]
    stack = checked.stack
    # With a laser, only frames that are left out move the moment.
    if math.isfinite(film.x_to_y_sigma_um):
        count_used = sum(frames.size for frames in used)
        if not film.is_worth_correcting or count_used == stack.readings_um.size:
            return None
        sigma_um = left_out_sigma_um(count_used, stack.readings_um.size, LASER_NOISE_UM)
        description = "the laser's noise where a frame is left out while the film moves"
    else:
        # Without one: the drift and its unevenness, and a step between the axes beyond the drift.
        frames = used[0], used[1]
        count_frames = len(stack.patterns)
        sigma_um = moment_sigma_um(frames, checked.film_um, checked.film_noise_um, count_frames)
        if seen is not None:
            apart = float(frames[1].mean() - frames[0].mean())
            step_um = seen.moved_um - apart * drift_um(frames, checked.film_um)
            stepped_um = step_sigma_um(frames, step_um, seen.sigma_um, count_frames)
            sigma_um = math.hypot(sigma_um, stepped_um)
        description = "motion of the film during the set, without a laser"
    # Another moment is another depth of the bowl.
    deeper_mm = Surface.hencky_bowl(1e-3 * sigma_um, radius_mm).parameters
    return Source(
        "moment_um", description, sigma_um, deeper_mm[:, None], common=False, paired=False
    )
