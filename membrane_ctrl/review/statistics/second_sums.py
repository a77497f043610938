"""Sums of a series over each second, from which means over longer windows follow."""

import numpy as np

from membrane_ctrl.model.arrays import AnyArray, Column, IntArray, Singles

# A month has millions: single precision, which counts ticks exactly.
Seconds = AnyArray
Counts = Singles
SecondsOf = tuple[Seconds, Counts, Column]


def group_starts(number: AnyArray) -> IntArray:
    """Places (k,) where the runs of equal numbers begin in an array (n,) that is not empty."""
    return np.flatnonzero(np.concatenate(([True], number[1:] != number[:-1])))


class SecondSums:
    """Sums over whole seconds of the run, of several series at once,
    from blocks in order of time.
    """

    def __init__(self, series: int) -> None:
        self._parts: list[SecondsOf] = []
        self._series = series

    def add(self, time_s: Column, values: Column) -> None:
        """Add values to the sums of their seconds.

        Parameters
        ----------
        time_s : (n,) array
            Times, rising.
        values : (series, n) array
            All finite or all NaN at each time.
        """
        if not time_s.size:
            return
        second = np.floor(time_s + 1e-9).astype(np.int32)
        starts = group_starts(second)
        counts = np.diff(np.append(starts, time_s.size)).astype(np.float32)
        self._parts.append((second[starts], counts, np.add.reduceat(values, starts, axis=1)))

    def result(self) -> SecondsOf:
        """(k,) seconds with ticks, (k,) numbers of ticks, (series, k) sums."""
        if not self._parts:
            return (
                np.empty(0, dtype=np.int32),
                np.empty(0, dtype=np.float32),
                np.empty((self._series, 0)),
            )
        second, counts, sums = (
            np.concatenate(parts, axis=-1) for parts in zip(*self._parts, strict=True)
        )
        starts = group_starts(second)  # two blocks may share a second
        return (
            second[starts],
            np.add.reduceat(counts, starts),
            np.add.reduceat(sums, starts, axis=1),
        )
