"""Options of `ctl` may stand before the action."""

from typing import Any

from typer.core import TyperGroup


def _has_value_next(word: str) -> bool:
    return word.startswith("--") and "=" not in word and word not in ("--json", "--take-over")


class ActionFirst(TyperGroup):
    """Accept options before the action, too."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Move the action to the front; an option's value does not count as one."""
        words = zip(["", *args], args, strict=False)
        at = next(
            (
                n
                for n, (last, word) in enumerate(words)
                if word in self.commands and not _has_value_next(last)
            ),
            0,
        )
        return super().parse_args(ctx, [*args[at : at + 1], *args[:at], *args[at + 1 :]])
