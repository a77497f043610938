"""A simulation of the package `gpiod`: GPIO chips with contacts that a test opens,
closes or cuts.
"""

from collections.abc import Mapping
from typing import Literal


class EmulatedGpio:
    """A simulation of the package `gpiod`: chips with lines whose electrical levels a test sets.

    Attributes
    ----------
    contacts : dict of (str, int) to str
        By chip and line: "closed", "open" or "cut" (a broken wire).
    failing : OSError or None
        Raised by every call while set.
    """

    class line:  # noqa: N801 - the package's own name
        """Enumerations of the package."""

        class Direction:
            INPUT = "input"

        class Bias:
            PULL_UP = "pull-up"
            PULL_DOWN = "pull-down"
            DISABLED = "disabled"

        class Value:
            ACTIVE = "active"
            INACTIVE = "inactive"

    class LineSettings:
        """Settings of a line, as the package takes them."""

        def __init__(self, direction: str, bias: str, active_low: bool) -> None:
            self.direction = direction
            self.bias = bias
            self.active_low = active_low

    def __init__(self, contacts: dict[tuple[str, int], Literal["closed", "open", "cut"]]) -> None:
        self.contacts = contacts
        self.failing: OSError | None = None
        self.requests = 0

    def request_lines(
        self, chip: str, consumer: str, config: Mapping[int, LineSettings]
    ) -> "EmulatedRequest":
        """Request lines, as `gpiod.request_lines`.

        Parameters
        ----------
        chip : str
            Its device, such as `/dev/gpiochip0`.
        consumer : str
            Name of the program, which the kernel shows; ignored.
        config : mapping of int to LineSettings
            By number of the line on its chip.

        Raises
        ------
        OSError
            The present failure.
        ValueError
            The chip does not have a line.
        """
        self.check()
        if missing := [line for line in config if (chip, line) not in self.contacts]:
            raise ValueError(f"line {missing[0]} does not exist")
        self.requests += 1
        return EmulatedRequest(self, chip, dict(config))

    def check(self) -> None:
        """Raise the present failure, if any."""
        if self.failing is not None:
            raise self.failing


class EmulatedRequest:
    """Requested lines, as `EmulatedGpio.request_lines` returns them.

    Parameters
    ----------
    gpio : EmulatedGpio
        With the present state of the contacts.
    chip : str
        Device of the chip.
    config : mapping of int to LineSettings
        By number of the line.
    """

    def __init__(
        self, gpio: EmulatedGpio, chip: str, config: Mapping[int, EmulatedGpio.LineSettings]
    ) -> None:
        self._gpio = gpio
        self._chip = chip
        self._config = config
        self.released = False

    def get_values(self, lines: list[int]) -> list[str]:
        """Values of lines in their order."""
        self._gpio.check()
        return [self._value(line) for line in lines]

    def release(self) -> None:
        """Give the lines back."""
        self.released = True

    def _value(self, line: int) -> str:
        settings = self._config[line]
        raised = self._is_raised(line, settings)
        active = not raised if settings.active_low else raised
        if active:
            return EmulatedGpio.line.Value.ACTIVE
        return EmulatedGpio.line.Value.INACTIVE

    def _is_raised(self, line: int, settings: EmulatedGpio.LineSettings) -> bool:
        """The electrical level: the contact's if it is closed,
        otherwise that of the pull resistor.
        """
        # The wiring follows from the settings, as a person would wire it: a contact to ground for a
        # line that is active when low, else to the supply. A pull resistor in the other direction
        # makes a cut wire look open.
        to_ground = settings.active_low
        if self._gpio.contacts[self._chip, line] == "closed":
            return not to_ground
        if settings.bias == "disabled":
            return to_ground
        return settings.bias == EmulatedGpio.line.Bias.PULL_UP
