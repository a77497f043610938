"""A session of two questions that writes its answers: a stand-in for `commission --messages`.

python small_session.py FOLDER --messages [--twin]
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

from membrane_ctrl.commissioning.guide.dialogue import (
    Question,
    QuestionKind,
    StageHead,
    StageProgress,
    StageResult,
)
from membrane_ctrl.commissioning.guide.session_messages import MessageDisplay, hear_interrupts
from membrane_ctrl.commissioning.guide.session_state import CheckRecord, CheckVerdict

HEAD = StageHead(step=4, title="First inflation", name="inflation", does="fills", look_for="film")


def main(folder: Path) -> int:
    """Ask, write the answers to `told.txt`, and end as the last answer wants."""
    hear_interrupts()
    display = MessageDisplay(sys.stdin, sys.stdout, lambda: os.kill(os.getpid(), signal.SIGINT))
    told = (folder / "told.txt").open("a", buffering=1)
    try:
        plan = StageProgress(step=4, title=HEAD.title, name=HEAD.name, result=StageResult.OPEN)
        display.show_plan((plan,))
        display.show_stage(HEAD)
        fill = Question(key="fill", kind=QuestionKind.CONFIRMATION, text="Fill to 3.7 mm?")
        told.write(f"fill {display.ask_question(fill)}\n")
        found = CheckRecord(name="pressure", measured="0.6 Pa", verdict=CheckVerdict.PASSED)
        display.show_check(found)
        display.show_line("  holding <b>3.71</b> mm")
        more = Question(key="more", kind=QuestionKind.CONFIRMATION, text="Fill to 13 mm?")
        told.write(f"more {display.ask_question(more)}\n")
        # A long stage, in short waits: a signal just before one sleep of 600 s would end it only
        # after these.
        for _ in range(6000):
            time.sleep(0.1)
    except (KeyboardInterrupt, EOFError):
        told.write("stopped safely\n")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
