"""The binary stream of an optoNCDT 1420: bytes to distances.

Manual optoNCDT 1420, 7.5.2 (pages 65-67): a value is 18 bits in three bytes of six, marked in their two highest bits:
low `00`, middle `01`, high `10` for the first value of a measurement and `11` for further ones. Here a measurement is
distance and measurement counter (`OUTADD_RS422 COUNTER`), six bytes.

There is no checksum, and where bytes are lost two measurements can join to one that never was. The counter shows it:
a measurement is trusted only when its counter is the one before plus one.
"""

import numpy as np
from numpy.typing import NDArray

BYTES = 6  # a measurement
COUNTER_MODULUS = 2**18
RAW_MAX = 65_520  # above it an error code
_MARKS = (0, 1, 2, 0, 1, 3)


class StreamParser:
    """Bytes in any portions to measurements.

    Attributes
    ----------
    bytes_lost : int
        That belonged to no measurement, so far.
    untrusted : int
        Measurements that did not follow on the one before, so far.
    """

    def __init__(self) -> None:
        self.bytes_lost = 0
        self.untrusted = 0
        self._rest = b""
        self._counter = -1

    def feed(self, data: bytes) -> NDArray[np.int64]:
        """Digital values or error codes (n,) of the trusted measurements that are complete with these bytes."""
        stream = np.frombuffer(self._rest + data, np.uint8)
        marks = stream >> 6
        starts = np.arange(max(0, len(stream) - BYTES + 1))
        found = np.ones(len(starts), bool)
        for offset, mark in enumerate(_MARKS):
            found &= marks[offset : offset + len(starts)] == mark
        starts = starts[found]
        used = int(starts[-1]) + BYTES if len(starts) else max(0, len(stream) - BYTES + 1)
        self.bytes_lost += used - BYTES * len(starts)
        self._rest = stream[used:].tobytes()
        if not len(starts):
            return np.empty(0, np.int64)
        bits = (stream & 0x3F).astype(np.int64)
        raw = bits[starts] | bits[starts + 1] << 6 | bits[starts + 2] << 12
        counters = bits[starts + 3] | bits[starts + 4] << 6 | bits[starts + 5] << 12
        before = np.concatenate(([self._counter], counters[:-1]))
        trusted = counters == (before + 1) % COUNTER_MODULUS
        self._counter = int(counters[-1])
        self.untrusted += int(np.count_nonzero(~trusted))
        values: NDArray[np.int64] = raw[trusted]
        return values


def distance_mm(raw: float, range_mm: float) -> float:
    """Distance from the start of the measuring range (page 65, without mastering): (1.02 x / 65520 - 0.01) range."""
    return (1.02 * raw / RAW_MAX - 0.01) * range_mm
