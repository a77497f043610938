"""A device of Modbus registers with nothing but values in them: what a configured map talks to."""

from collections.abc import Callable, Mapping, Sequence

from firmware_iface.drivers.modbus_map import ValueMap
from firmware_iface.emulators import modbus_server

READ_INPUT = 4


class MapDevice:
    """A `RegisterTable` for any server.

    Parameters
    ----------
    sensors : mapping
        Maps of values that are read, each with the function that says the value now.
    outputs : mapping
        Maps of values that are written, each with the function that is told.
    constants : mapping
        Address to word, for identity and version.
    raw_limits : tuple of int
        Words outside are refused with exception 3.
    """

    def __init__(
        self,
        sensors: Mapping[ValueMap, Callable[[], float]],
        outputs: Mapping[ValueMap, Callable[[float], None]],
        constants: Mapping[int, int] | None = None,
        raw_limits: tuple[int, int] = (0, 0xFFFF),
    ) -> None:
        self._sensors = sensors
        self._outputs = outputs
        self._constants = dict(constants or {})
        self._raw_limits = raw_limits
        self.restart()

    def restart(self) -> None:
        """Power-up: every output at the raw value 0, and the plant is told what that means, if anything."""
        self._written = {found.address + n: 0 for found in self._outputs for n in range(found.words)}
        for found, tell in self._outputs.items():
            self._tell(found, tell)

    def read(self, address: int, count: int) -> list[int]:
        """Words. Raises RegisterRefusal."""
        words = {**self._constants, **self._written}
        for found, value in self._sensors.items():
            words.update(enumerate(found.encode(value()), found.address))
        try:
            return [words[at] for at in range(address, address + count)]
        except KeyError:
            raise modbus_server.RegisterRefusal(modbus_server.ILLEGAL_ADDRESS) from None

    def write(self, address: int, words: Sequence[int]) -> None:
        """All or nothing. Raises RegisterRefusal."""
        places = range(address, address + len(words))
        if not all(at in self._written for at in places):
            raise modbus_server.RegisterRefusal(modbus_server.ILLEGAL_ADDRESS)
        if not all(self._raw_limits[0] <= word <= self._raw_limits[1] for word in words):
            raise modbus_server.RegisterRefusal(modbus_server.ILLEGAL_VALUE)
        self._written.update(zip(places, words, strict=True))
        for found, tell in self._outputs.items():
            self._tell(found, tell)

    def _tell(self, found: ValueMap, tell: Callable[[float], None]) -> None:
        value = found.decode([self._written[found.address + n] for n in range(found.words)])
        # a current below 4 mA is a broken wire to what hangs on the output: off
        tell(value if found.allows(value) else 0.0)


def respond_to_input(pdu: bytes, table: modbus_server.RegisterTable) -> bytes:
    """`respond`, and "read input registers" (function 4) answered from the same registers."""
    if pdu[0] != READ_INPUT:
        return modbus_server.respond(pdu, table)
    reply = modbus_server.respond(bytes([modbus_server.READ_HOLDING]) + pdu[1:], table)
    return bytes([reply[0] - modbus_server.READ_HOLDING + READ_INPUT]) + reply[1:]
