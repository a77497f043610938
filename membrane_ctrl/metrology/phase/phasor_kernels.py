"""Compiled steps on a single phasor: its angle, and the correction for the film's motion."""

import math

from membrane_ctrl.metrology.numerics.compiled import compile_step


@compile_step
def branchless_arctan2(y, x):  # type: ignore[no-untyped-def]
    """Angle in [-pi, pi] without a branch, so that loops over it use vector units; (0, 0) gives 0.

    The angle of the smaller over the larger coordinate is halved, which leaves t <= tan(pi/8),
    where 16 terms of the series of arctan leave less than 1e-13.

    Parameters
    ----------
    y, x : float
        Coordinates, as of `math.atan2`.
    """
    # The first octant, with 0 <= ratio <= 1; the smallest number keeps (0, 0) from 0 / 0.
    ax = abs(x)
    ay = abs(y)
    ratio = min(ax, ay) / (max(ax, ay) + 1e-300)

    # Half the angle: tan(a / 2) = t.
    t = ratio / (1 + math.sqrt(1 + ratio * ratio))

    # arctan t = t (1 - t^2/3 + t^4/5 - ...), by Horner's rule in t^2.
    square = t * t
    series = 0.0
    for k in range(15, -1, -1):
        series = 1.0 / (2 * k + 1) - square * series
    angle = 2 * t * series

    # The other octant, then the half planes x < 0 and y < 0.
    angle = math.pi / 2 - angle if ay > ax else angle
    angle = math.pi - angle if x < 0 else angle
    return -angle if y < 0 else angle


@compile_step
def remove_phasor_motion(c, s, q, turn, mirror):  # type: ignore[no-untyped-def]
    """The phasor c + i s without the film's motion, to second order.

    Solves z' = T z + M conj z for z (`reconstruction.film_motion`, section 7 of
    docs/explanation/metrology.md).

    Parameters
    ----------
    c, s : float
        The phasor z' that was seen.
    q : float
        The point's change of phase per µm.
    turn, mirror : (2,) complex arrays
        First and second moment of the motion, of T and of M.

    Returns
    -------
    real, imaginary : float
        Of z.
    """
    # T = 1 + i q turn_1 - q^2 turn_2 / 2, M = -i q mirror_1 - q^2 mirror_2 / 2
    half = q * q / 2
    t_re = 1 - q * turn[0].imag - half * turn[1].real
    t_im = q * turn[0].real - half * turn[1].imag
    m_re = q * mirror[0].imag - half * mirror[1].real
    m_im = -q * mirror[0].real - half * mirror[1].imag
    # z = (conj T z' - M conj z') / (|T|^2 - |M|^2)
    scale = 1 / (t_re * t_re + t_im * t_im - m_re * m_re - m_im * m_im)
    real = scale * ((t_re - m_re) * c + (t_im - m_im) * s)
    imaginary = scale * ((t_re + m_re) * s - (t_im + m_im) * c)
    return real, imaginary
