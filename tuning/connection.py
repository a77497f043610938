"""Connects a session to its hold, and restores the last good gains if it ends early."""

import contextlib
from collections.abc import Callable, Iterator

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.errors import DeviceError, InputError, convert_write_errors
from membrane_ctrl.sessions.folder import (
    SessionFolder,
    create_session,
    find_newest_session,
    open_session,
)
from membrane_ctrl.sessions.live_hold import HoldError, HoldLink, live_hold
from membrane_ctrl.sessions.live_log import LiveLog
from membrane_ctrl.sessions.progress import Progress
from tuning import same_bench, twin_hold
from tuning.options import TuneOptions
from tuning.rigs.hold_rig import HoldRig


@contextlib.contextmanager
def open_on_hold(
    options: TuneOptions,
    fresh: bool = False,
    again: str = "resume it with `membrane-ctrl tune run --resume {}`",
    refusal: Callable[[Config], str] = lambda config: "",
) -> Iterator[tuple[SessionFolder, HoldRig, Progress]]:
    """Yield a session's folder and hold; restore the last good gains if it ends early, and print
    how to continue.
    """
    progress = Progress()
    with connect_to_hold(options, f"tune {options.name}") as link:
        if refused := refusal(link.config):
            raise InputError(refused)
        # The gains to return to are those before the session.
        folder = find_session(options, link, fresh)
        rig = HoldRig(link, options.author, progress)
        rig.good = folder.head.before, folder.config.pump
        progress.log = LiveLog(folder.path, rig.loop.rate_hz, progress.print_line)
        rig.seen = progress.log.add_tick
        # Whatever ends the block early, also Ctrl-C, restores them.
        with progress.catch_signals():
            try:
                rig.end_experiment()  # of a session that was killed
                with convert_write_errors(folder.path, DeviceError):
                    yield folder, rig, progress
                progress.log_entry("ended", "done")
            except BaseException as error:
                _restore_gains(rig, progress)
                progress.log_entry("ended", str(error) or "interrupted")
                progress.print_line(again.format(folder.path))
                if isinstance(error, HoldError):
                    raise DeviceError(str(error)) from None
                raise


def _restore_gains(rig: HoldRig, progress: Progress) -> None:
    progress.interrupted = False
    try:
        rig.restore_good_gains()
    except HoldError as error:
        progress.print_line(
            f"could not restore the last good gains ({error}); gains on trial revert automatically"
        )
        return
    progress.print_line("holding the mirror with the last good gains")


def connect_to_hold(
    options: TuneOptions, session: str = ""
) -> contextlib.AbstractContextManager[HoldLink]:
    """Connect to the hold; with the name of a `session`, claim its command."""
    if not options.twin:
        return live_hold(options.where, options.take_over, wait=options.wait, session=session)
    config = open_session(options.session).config if options.session is not None else options.config
    try:
        return contextlib.closing(twin_hold.TwinHold(config))
    except HoldError as error:
        raise DeviceError(str(error)) from None


def find_session(options: TuneOptions, link: HoldLink | None, fresh: bool = False) -> SessionFolder:
    """Return the named session, else the newest, or a new one if there is a hold to start it on."""
    if link is None:
        return (
            find_newest_session(options.logs)
            if options.session is None
            else open_session(options.session)
        )
    if options.session is not None:
        return same_bench.continue_on_hold(open_session(options.session), link)
    begun: SessionFolder | None = None
    if not fresh:
        with contextlib.suppress(InputError):
            begun = find_newest_session(options.logs)
    of = None if begun is None else (begun.head.source, begun.head.name)
    if begun is not None and of == (link.name, options.name) and not begun.is_done("verify"):
        return same_bench.continue_on_hold(begun, link)
    return create_session(
        options.logs, options.name, options.author, link.name, link.config, link.config.loop
    )
