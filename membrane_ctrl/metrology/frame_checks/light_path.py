"""What the frames of an accepted set show of blur, second images and the response to light."""

from dataclasses import replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks import (
    film_image,
    light_response,
    picture_blur,
    second_reflection,
)
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor, Checked
from membrane_ctrl.metrology.frame_checks.sampled_bins import SampledBins
from membrane_ctrl.model.arrays import FloatArray


def measure_light_path(
    checked: Checked,
    scene: SampledBins,
    excluded: set[int],
    optics: OpticsConfig,
    anchor: Anchor | None,
) -> Checked:
    """Measure what an accepted set shows of blur, second images and the response to light.

    Parameters
    ----------
    checked : Checked
        The set.
    scene : SampledBins
        Its bins, with the phases that its surface predicts.
    excluded : set of int
        Frames that are not used.
    optics : OpticsConfig
        The bench.
    anchor : Anchor or None
        Fringe orders and images of the set that this one refers to.

    Returns
    -------
    Checked
        The set with its `second`, `response`, `image` and `blur_px`.
    """
    # Blur carries light across the edges of the Gray bits: a second image is searched beyond it.
    rows, columns = checked.view.mask.shape
    bin_px = checked.binned.bin_px
    gradients = picture_blur.phase_gradients(scene.phase_rad, scene.index, (rows, columns), bin_px)
    swings = checked.view.swing_adu.reshape(2, -1)[:, scene.index]
    blur_px = picture_blur.estimate_blur_px(gradients, swings, bin_px)
    second = second_reflection.find_second_reflection(
        checked.stack, checked.binned, scene, excluded, optics.pattern, blur_px * gradients
    )
    position_mm = np.array(checked.tracer.position_mm(checked.state.points))
    response = light_response.estimate_response(
        checked.stack,
        checked.binned,
        checked.state.index,
        position_mm / optics.mirror.radius_mm,
        excluded,
        checked.view.used,
    )
    image = _find_film_image(checked, excluded, optics, anchor)
    return replace(checked, second=second, response=response, image=image, blur_px=blur_px)


def _find_film_image(
    checked: Checked, excluded: set[int], optics: OpticsConfig, anchor: Anchor | None
) -> film_image.FilmImage:
    """A second reflection of the screen in a part of the mirror, if the bench has no front film.

    By white and black of the set, or of the set that it refers to, or else by the mean light of
    its fringes.
    """
    geometry = checked.tracer.geometry
    if geometry.cushion is not None:
        return film_image.NO_FILM_IMAGE
    pair = checked.stack.white_and_black(excluded)
    if pair is not None:
        white, black = pair
        light = checked.binned.means[white].astype(float) - checked.binned.means[black]
        evidence = film_image.ImageEvidence.WHITE_AND_BLACK
    elif anchor is not None and anchor.image.evidence is film_image.ImageEvidence.WHITE_AND_BLACK:
        return anchor.image
    else:
        light = checked.view.light
        evidence = film_image.ImageEvidence.MEAN_LIGHT

    # Bins on the mirror, about where their rays cross the middle of the bowl's depth.
    index = np.flatnonzero(checked.view.mask & checked.near)
    rays = geometry.rays(*checked.places_px(index))
    depth_mm = checked.state.surface.sag_mm / 2
    t = (depth_mm - geometry.pinhole_mm[2]) / rays[2]
    position_mm = geometry.pinhole_mm[:2, None] + t * rays[:2]
    on_film = np.hypot(*position_mm) < optics.mirror.analysis_radius_mm
    index = index[on_film]
    swing_adu = checked.view.swing_adu

    def compute_swing() -> FloatArray:
        """Amplitude of the fringes, mean of both axes."""
        return np.asarray(swing_adu.mean(axis=0).reshape(-1)[index])

    return film_image.find_film_image(
        (light.shape[0], light.shape[1]),
        index,
        position_mm[:, on_film],
        light.reshape(-1)[index],
        compute_swing,
        evidence,
    )
