"""Which lines of a log a viewer has not seen."""


def find_new_lines(old: tuple[str, ...], new: tuple[str, ...]) -> tuple[str, ...]:
    """The lines of `new` after those of `old`; the first of `old` may have been dropped since."""
    return next(
        new[len(old) - gone :]
        for gone in range(len(old) + 1)
        if old[gone:] == new[: len(old) - gone]
    )
