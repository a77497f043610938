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
    """Yield a session's folder, its hold and its progress.

    If the block ends early, the last good gains are restored, and it is printed how to continue.

    Parameters
    ----------
    options : TuneOptions
        Of the command: which hold, or the twin; which session; what to print.
    fresh : bool
        Start a new session, even if the newest one on this hold is not finished.
    again : str
        The line that states how to continue; `{}` becomes the session's folder.
    refusal : callable
        Why the configuration of the hold is not fit for this command; empty if it is.

    Raises
    ------
    InputError
        The hold is refused, or the named session does not fit it.
    DeviceError
        There is no such hold, it ends, or the session's folder cannot be written.
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
    """Connect to the running hold, or start one on the twin.

    Parameters
    ----------
    options : TuneOptions
        Of the command: which hold, whether to wait for it and to take its command over. On the
        twin, a resumed session has the configuration that it began with.
    session : str
        Name under which the command of the hold is claimed; empty: only read.

    Returns
    -------
    context manager of HoldLink
        Its end releases the command; a hold on the twin ends.

    Raises
    ------
    DeviceError
        There is no such hold, or another client has its command.
    """
    if not options.twin:
        return live_hold(options.where, options.take_over, wait=options.wait, session=session)
    config = open_session(options.session).config if options.session is not None else options.config
    try:
        return contextlib.closing(twin_hold.TwinHold(config))
    except HoldError as error:
        raise DeviceError(str(error)) from None


def find_session(options: TuneOptions, link: HoldLink | None, fresh: bool = False) -> SessionFolder:
    """Find the session to continue, or create one.

    Parameters
    ----------
    options : TuneOptions
        `session` is the folder of a session; without it, the newest one counts.
    link : HoldLink or None
        The hold. None: a session is only read, and none is created. With a hold, the newest session
        is continued only if it has the same name, began on this hold and is not verified.
    fresh : bool
        Create a session, unless `options` name one.

    Raises
    ------
    InputError
        There is no session, or the named one does not fit the hold.
    """
    if link is None:
        return (
            find_newest_session(options.logs)
            if options.session is None
            else open_session(options.session)
        )
    if options.session is not None:
        return same_bench.continue_on_hold(open_session(options.session), link)
    # The newest session continues if it is one of this hold and name, and not finished: so the
    # single steps of `tune`, given one after the other, belong to one session.
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
