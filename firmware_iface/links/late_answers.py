"""How late the answers of a slow link come: a link that is slow is not one that is dead."""

# Questions after a late answer for which it still explains why there is no answer
_EXPLAINS_QUESTIONS = 3


class LateAnswers:
    """Remembers the last answer that came after its question was given up.

    Its text names a slow link only while late answers come: a line that was cut after one is not
    slow.
    """

    def __init__(self) -> None:
        self._late_s = 0.0
        self._questions = _EXPLAINS_QUESTIONS + 1  # since the last late answer

    def note_question(self) -> None:
        """A question is sent."""
        self._questions += 1

    def note_in_time(self) -> None:
        """An answer came in time."""
        self._questions = _EXPLAINS_QUESTIONS + 1

    def note_late(self, late_s: float) -> None:
        """An answer came so long after its question, which had been given up."""
        self._late_s = late_s
        self._questions = 0

    def explain(self) -> str:
        """What explains that there is no answer in time; empty if it is not this."""
        if self._questions > _EXPLAINS_QUESTIONS:
            return ""
        return (
            f"answers come late, the last one {self._late_s:.2f} s after its question: the device, "
            "a converter or the network is slow; repair that, or raise timeout_s"
        )
