"""`tune watch`: report whether a session is due."""

import json

from membrane_ctrl.model.errors import DeviceError, Exit, InputError
from membrane_ctrl.sessions import session_json
from membrane_ctrl.sessions.live_hold import HoldError
from membrane_ctrl.sessions.progress import Progress
from tuning import connection, gains_file
from tuning.options import TuneOptions
from tuning.rigs.hold_rig import HoldRig


def watch_hold(options: TuneOptions) -> int:
    """Observe a hold and report whether a session is due (exit 3)."""
    from tuning.proposal.loop_health import judge_health

    # What the last session designed, and what it expected of it.
    folder = connection.find_session(options, None)
    folder.require_done("design")
    made = gains_file.load_gains(folder.file_path("gains.toml"))
    with connection.connect_to_hold(options) as link:
        progress = Progress()
        rig = HoldRig(link, options.author, progress)
        progress.begin_step("watch", options.observe_s, 0.0)
        try:
            found = judge_health(*rig.hold_about(options.observe_s), rig.loop, made)
        except HoldError as error:
            raise DeviceError(str(error)) from None
        except ValueError as error:
            raise InputError(f"watch: {error}") from None
    if options.json:
        print(json.dumps(session_json.to_plain(found)))
    progress.print_line(
        f"std {found.std_um:.3f} µm, {found.ratio:.2f} of the lower bound "
        f"({found.ratio_designed:.2f} expected); k {found.gain:.2f} +- {found.gain_sigma:.2f}; "
        f"leak {found.leak_um_per_s:.2f} µm/s"
    )
    for suggestion in found.suggestions:
        progress.print_line(f"a tuning session is due: {suggestion}")
    return Exit.REJECTED if found.suggestions else Exit.DONE
