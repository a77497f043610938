"""Options of `ctl` may stand before the action."""

from typing import Any

from typer.core import TyperGroup

_FLAGS = ("--json", "--take-over")  # the common options that have no value


def _has_value_next(word: str) -> bool:
    """Whether the next word is the value of this option, such as `FILE` in `--run FILE`."""
    return word.startswith("--") and "=" not in word and word not in _FLAGS


class ActionFirst(TyperGroup):
    """Accept options before the action, too."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Move the action to the front, then parse as usual.

        Parameters
        ----------
        ctx : Context
            Of the group `ctl`.
        args : list of str
            The words after `ctl`. The first one that names an action is the action, unless it is
            the value of an option: in `--run hold setpoint 3`, `hold` is a folder.

        Returns
        -------
        list of str
            What is left for the action.
        """
        last = ""
        for place, word in enumerate(args):
            if word in self.commands and not _has_value_next(last):
                args = [word, *args[:place], *args[place + 1 :]]
                break
            last = word
        return super().parse_args(ctx, args)
