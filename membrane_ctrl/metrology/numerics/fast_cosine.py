"""Cosine and sine in single precision for vector units."""

import math

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_step


@compile_step
def cos_sin(x):  # type: ignore[no-untyped-def]
    """Cosine and sine of a phase in single precision, to 1e-6 within three turns.

    Taylor's series about the nearest quarter of a turn: unlike a library's functions, they run on
    vector units.
    """
    # x = quarter pi / 2 + y, |y| <= pi / 4.
    quarter = np.rint(x * np.float32(2 / math.pi))
    y = x - quarter * np.float32(math.pi / 2)
    z = y * y

    # cos y = 1 - z (1/2! - z (1/4! - z (1/6! - z/8!))), by Horner's rule in z = y^2.
    c = np.float32(1 / 720) - z * np.float32(1 / 40320)
    c = np.float32(1 / 24) - z * c
    c = np.float32(1 / 2) - z * c
    c = np.float32(1) - z * c

    # sin y = y - y z (1/3! - z (1/5! - z (1/7! - z/9!))).
    s = np.float32(1 / 5040) - z * np.float32(1 / 362880)
    s = np.float32(1 / 120) - z * s
    s = np.float32(1 / 6) - z * s
    s = y - y * z * s

    # Each quarter turns (c, s) into (-s, c): an odd number swaps them, two change both signs.
    k = np.int32(quarter)
    if k & 1:
        c, s = -s, c
    if k & 2:
        c, s = -c, -s
    return c, s
