"""`tune rollback`: restore the gains from before the last kept session."""

import math

from membrane_ctrl.model.errors import DeviceError, Exit
from membrane_ctrl.sessions.live_hold import HoldError
from membrane_ctrl.sessions.progress import Progress
from tuning import connection, gains_file, journal
from tuning.options import TuneOptions
from tuning.rigs.hold_rig import HoldRig


def roll_back(options: TuneOptions) -> int:
    """Restore the gains from before the last kept session."""
    # Set the gains that were there before it.
    kept = journal.find_roll_back(options.logs)
    progress = Progress()
    with connection.connect_to_hold(options) as link:
        rig = HoldRig(link, options.author, progress)
        try:
            shape_s = kept.shape_s[0] if kept.shape_s else math.nan
            loop = gains_file.adapt_to_hold(kept.before, rig.loop)
            rig.set_gains(
                loop, f"rollback of {kept.session}: {options.reason}"[:250], shape_s=shape_s
            )
        except HoldError as error:
            raise DeviceError(str(error)) from None
    # Note it, also that a configuration may still have the others.
    entry = journal.make_entry(
        "rolled_back",
        kept.session,
        options.author,
        options.reason,
        kept.before,
        kept.after,
        shape_s=kept.shape_s,
    )
    journal.append_entry(options.logs, entry)
    found = (
        f"back to the gains before {kept.session}: K {kept.before.kp_per_s:g} 1/s, Ti "
        f"{kept.before.ti_s:g} s"
    )
    if kept.shape_s is not None:
        found += f", time constant of the shape loop {kept.shape_s[0]:.0f} s"
    progress.print_line(found)
    # Each configuration once, in the order in which they were saved.
    entries = journal.read_entries(options.logs)
    for saved in dict.fromkeys(entry.reason for entry in entries if entry.what == "saved"):
        progress.print_line(f"{saved} was saved with gains of a session: check its [loop]")
    return Exit.DONE
