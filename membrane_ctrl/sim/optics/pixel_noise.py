"""Reproducible normal noise of a picture's pixels, from the picture's seed."""

from functools import cache
from statistics import NormalDist

import numpy as np

from membrane_ctrl.model.arrays import Singles
from membrane_ctrl.model.kernel_cache import compile_loop

GOLDEN, MIX_1, MIX_2 = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xBF58476D1CE4E5B9),
    np.uint64(0x94D049BB133111EB),
)
LOW_16 = np.uint64(0xFFFF)


@cache
def normal_quantiles() -> Singles:
    """65536 equally likely values of a unit normal distribution: 16 random bits pick one."""
    half = [NormalDist().inv_cdf((k + 0.5) / 65536) for k in range(32768)]
    values = np.concatenate([half, -np.array(half[::-1])])
    return np.asarray(values / values.std(), dtype=np.float32)


@compile_loop()
def random_64_bits(state: np.uint64) -> np.uint64:
    """SplitMix64's output for a state that grows by `GOLDEN` (Steele et al., 2014): four 16-bit
    numbers.
    """
    z = (state ^ (state >> np.uint64(30))) * MIX_1
    z = (z ^ (z >> np.uint64(27))) * MIX_2
    return z ^ (z >> np.uint64(31))


@cache
def noise_bank() -> Singles:
    """A quarter of a million values of a unit normal distribution; each row of a picture takes its
    own part.
    """
    return np.random.default_rng(0).permutation(np.tile(normal_quantiles(), 4))
