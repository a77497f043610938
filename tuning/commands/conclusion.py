"""The end of a command: the session's folder or JSON on the terminal, and the exit code."""

import json
import sys

from membrane_ctrl.model.errors import Exit
from membrane_ctrl.sessions.folder import STEPS, SessionFolder
from tuning.options import TuneOptions
from tuning.steps import verify


def conclude(folder: SessionFolder, options: TuneOptions) -> int:
    """Print where the session is, and return the exit code.

    Parameters
    ----------
    folder : SessionFolder
        Whose results decide the exit code.
    options : TuneOptions
        `json` prints the finished steps on stdout.

    Returns
    -------
    int
        Rejected if the gains of the session were not kept.
    """
    if options.json:
        done = [step for step in STEPS if folder.is_done(step)]
        print(json.dumps({"session": str(folder.path), "done": done}))
    else:
        print(f"session: {folder.path}", file=sys.stderr)
    refused = folder.is_done("verify") and not verify.load_verified(folder).kept
    return Exit.REJECTED if refused else Exit.DONE
