"""A plant behind an emulated board whose mirror stands still."""

from firmware_iface.emulators.pump_board import BoardSample


class StillPlant:
    """A mirror that stands; keeps what pump and vent were driven with."""

    def __init__(self) -> None:
        self.outputs: list[tuple[float, float]] = []
        self._counter = 0

    def sample(self) -> BoardSample:
        self._counter += 1
        return BoardSample(
            12.5, 0, 600.0, 101_325.0, 22.5, 23.0, self._counter, self._counter / 200
        )

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        self.outputs.append((pump_fraction, vent_fraction))
