"""Requests and answers over a line without transaction numbers, without ever mixing them up.

The danger is a device that answers late: its answer to an abandoned question looks like the answer
to the next one. Three rules keep them apart.

1. One question is on the wire at a time and stays there until answered or timed out, whatever
   happens to the caller: a cancelled caller leaves nothing behind.
2. After any loss (no answer, a wrong one, unsolicited bytes) nothing is sent until the line has
   been quiet for `quiet_s`.
3. Then comes a *fence*: a harmless question with an unmistakable answer. Devices answer in order,
   so once the fence is answered, any earlier answer has come (and was discarded) or never will.

Two faults of the line have signatures of their own, so that they are named: what was sent comes
back before the answer (local echo of an RS-485 adapter), and a valid answer comes after its time.
"""

import asyncio
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass

from firmware_iface.links.late_answers import LateAnswers
from firmware_iface.links.serial_port import SerialPort
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError

_ECHO = (
    "the adapter echoes what is sent; switch its local echo off (on RS-485, disable the receiver "
    "while sending)"
)
_ONLY_ECHO = (
    "only what was sent comes back: the device is silent and the adapter echoes, or the line's "
    "two directions are joined"
)
_SHOWN_BYTES = 24
# after this many questions without a valid answer the line is closed: its owner then reopens it,
# which also applies the settings that a device loses with its power
_FAILURES_MAX = 5
# bytes beyond the longest answer: noise before it; a device that sends without end must not fill
# the memory
_EXTRA_BYTES_MAX = 4096
_ABANDONED_MAX = 4  # questions whose late answers are recognised


@dataclass(frozen=True, slots=True)
class WireQuestion:
    """A request, and how to recognise its answer."""

    data: bytes  # sent unchanged
    # from all bytes so far: the answer, None while incomplete. Raises LinkError for anything else
    extract_answer: Callable[[bytes], bytes | None]
    answer_bytes: (
        int  # length of the longest answer: its time on the wire is added to the device's own
    )
    what: str  # for messages: device and request
    # a valid answer may equal the question: then an echo cannot be recognised by it
    answer_repeats: bool = False
    # a valid answer shows that the device can be read: the next `open` may follow at once
    reads: bool = True


@dataclass(slots=True)
class _Abandoned:
    """A question that was not answered in time, and the bytes since it was asked."""

    question: WireQuestion
    request_s: float
    received_bytes: bytes


class SerialExchange:
    """Questions and answers on one line, for one device or several that take turns.

    Parameters
    ----------
    port : SerialPort
        The line; this is its only user.
    gap_s : float
        Silence that the devices need between an answer and the next question.
    quiet_s : float
        Silence after a loss: the usual upper limit of late answers; the fence covers the rest.
    blank : bytes
        Bytes that mean nothing between answers, like the LF after a CR that already ended one.
    """

    def __init__(self, port: SerialPort, gap_s: float, quiet_s: float, blank: bytes = b"") -> None:
        self.port = port
        self._gap_s = gap_s
        self._quiet_s = quiet_s
        self._blank = blank
        self._key_turns: defaultdict[int, asyncio.Lock] = defaultdict(asyncio.Lock)
        # released when the question ends, whatever happens to its caller
        self._turn = asyncio.Lock()
        self._in_flight: asyncio.Task[bytes] | None = None
        self._sure: set[int] = set()  # devices without outstanding answers
        self._failures = 0
        self._noisy = False
        self._last_byte_s = 0.0
        self._buffer = b""
        self._question: WireQuestion | None = None  # the last one
        self._answer: asyncio.Future[bytes] | None = None
        # the last questions without a valid answer in time, oldest first
        self._abandoned: deque[_Abandoned] = deque(maxlen=_ABANDONED_MAX)
        # the last question that was answered by its own bytes; the same bytes once more are the
        # device's answer after an echo
        self._repeated = b""
        self._echoes = False
        self._late = LateAnswers()

    def connect(self, greeting: bytes = b"") -> None:
        """Open the line; discard outstanding answers to an earlier user.

        The greeting is sent at once and its answer discarded, for devices that send unasked until
        stopped. Raises LinkDownError if the port does not open.
        """
        self.port.open(self)
        self._sure.clear()
        self._failures = 0
        self._noisy = True
        self._abandoned.clear()
        self._repeated = b""
        self._echoes = False
        self._last_byte_s = asyncio.get_running_loop().time()
        if greeting:
            self.port.write(greeting)

    async def close(self) -> None:
        """Close the line; a question in flight fails at once."""
        self.port.close()
        self.lost(LinkDownError(f"{self.port.name}: closed"))
        if self._in_flight is not None:
            await asyncio.wait([self._in_flight])

    async def ask(
        self, question: WireQuestion, timeout_s: float, fence: WireQuestion | None, key: int = 0
    ) -> bytes:
        """Ask a question once and return its answer; nothing is ever resent automatically.

        Parameters
        ----------
        question : WireQuestion
            What to send, and how to recognise its answer.
        timeout_s : float
            Time of the device; that on the wire is added.
        fence : WireQuestion or None
            Question whose answer shows that no earlier answer is still to come; without one, only
            the silence `quiet_s` protects the device.
        key : int
            The device. Devices that wait are served in turn, each with one question.

        Raises
        ------
        LinkError
            No valid answer.
        LinkDownError
            The line is closed or went away.
        """
        # Two locks make the turns fair between devices: a device has one question at a time in the
        # queue for the line, however many of its callers wait.
        async with self._key_turns[key]:
            await self._turn.acquire()  # cancelled while waiting here, a question is never sent
            self._in_flight = asyncio.create_task(self._transact(question, timeout_s, fence, key))
            self._in_flight.add_done_callback(self._release_turn)
            return await asyncio.shield(self._in_flight)

    def _release_turn(self, task: asyncio.Task[bytes]) -> None:
        self._turn.release()
        if not task.cancelled():
            task.exception()  # after a cancelled caller no other task retrieves it

    async def _transact(
        self, question: WireQuestion, timeout_s: float, fence: WireQuestion | None, key: int
    ) -> bytes:
        try:
            self._require_open(question.what)
            # Rule 2: silence. Rule 3: after a loss, the fence, for each device of the line the
            # next time that it is asked. `_sure` holds the devices that need none.
            await self._wait_for_silence(question.what, timeout_s)
            if key not in self._sure and fence is not None:
                await self._ask_once(fence, timeout_s)
                await self._wait_for_silence(question.what, timeout_s)
            answer = await self._ask_once(question, timeout_s)
        except LinkDownError:
            raise
        except LinkError as error:
            # A loss: from here on the line counts as noisy, and after some the port is closed
            self._sure.discard(key)
            self._noisy = True
            self._last_byte_s = asyncio.get_running_loop().time()
            self._failures += 1
            if self._failures < _FAILURES_MAX:
                raise
            self.port.close()
            raise LinkDownError(
                f"{error}; the {_FAILURES_MAX}th failure in a row, connection given up"
            ) from error
        self._failures = 0
        self._sure.add(key)
        if question.reads:
            self.port.succeeded()
        return answer

    async def _wait_for_silence(self, what: str, timeout_s: float) -> None:
        """Wait for the silence that is due."""
        # Bytes that arrive during the wait move its end. The wait may last two silences and the
        # time of one answer; on a line that talks longer there is no silence to find.
        loop = asyncio.get_running_loop()
        give_up_s = loop.time() + 2 * self._quiet_s + timeout_s
        while True:
            due_s = self._last_byte_s + (self._quiet_s if self._noisy else self._gap_s)
            if (wait_s := due_s - loop.time()) <= 0:
                self._noisy = False
                return
            if due_s > give_up_s:
                raise LinkError(
                    f"{what}: the line never goes quiet; wrong baud rate, or another talker"
                )
            await asyncio.sleep(wait_s)

    async def _ask_once(self, question: WireQuestion, timeout_s: float) -> bytes:
        self._require_open(question.what)
        # An echo that was found between two questions is reported by the second one, before
        # anything else is sent.
        if self._echoes:
            self._echoes = False
            self._repeated = b""
            raise DeviceRefusedError(f"{question.what}: {_ECHO}")
        loop = asyncio.get_running_loop()
        self.port.write(question.data)
        self._buffer = b""
        self._question = question
        request_s = loop.time()
        self._late.note_question()
        answer: asyncio.Future[bytes] = loop.create_future()
        self._answer = answer
        wire_s = (len(question.data) + question.answer_bytes) * self.port.settings.char_s
        try:
            # not asyncio.timeout: it discards an answer that arrived while this process was
            # suspended
            await asyncio.wait([answer], timeout=timeout_s + wire_s)
        finally:
            self._answer = None
        # No answer in time. The question stays in `_abandoned`, so that its late answer is
        # recognised and the next error can state how late the device is.
        if not answer.done():
            if self._buffer == question.data:
                raise DeviceRefusedError(f"{question.what}: {_ONLY_ECHO}")
            self._abandoned.append(_Abandoned(question, request_s, self._buffer))
            raise LinkError(f"{question.what}: {self._explain_missing_answer(timeout_s)}")
        if answer.exception() is not None:  # its own answer may still come
            self._abandoned.append(_Abandoned(question, request_s, b""))
            return answer.result()
        self._late.note_in_time()
        self._abandoned.clear()
        received_bytes = answer.result()
        # The answer equals the question: a device that confirms by repeating, or an echo. Only
        # bytes that follow can show which.
        if self._buffer == question.data:
            self._repeated = question.data
        else:
            self._repeated = b""
        return received_bytes

    def _require_open(self, what: str) -> None:
        if not self.port.is_open:
            raise LinkDownError(f"{what}: not connected")

    def _explain_missing_answer(self, timeout_s: float) -> str:
        if slow := self._late.explain():
            return f"no answer within {timeout_s:g} s; {slow}"
        if not self._buffer:
            return (
                f"no answer within {timeout_s:g} s; is it on, wired and set to "
                f"{self.port.settings}?"
            )
        shown = self._buffer[:_SHOWN_BYTES]
        return (
            f"incomplete answer within {timeout_s:g} s: {len(self._buffer)} bytes ({shown!r}); "
            "wrong baud rate?"
        )

    def received(self, data: bytes) -> None:
        """Bytes came (called by the port)."""
        self._last_byte_s = asyncio.get_running_loop().time()
        is_late = self._completes_abandoned(data)
        # Without a question these bytes are a late answer, an echo, or noise.
        if self._answer is None or self._answer.done() or self._question is None:
            self._noisy |= bool(data.strip(self._blank))  # unsolicited
            self._echoes |= self._is_second_copy(data)
            return
        # More bytes than the answer and an echo can have end the question.
        question = self._question
        self._buffer += data
        if len(self._buffer) > question.answer_bytes + _EXTRA_BYTES_MAX:
            self._answer.set_exception(
                LinkError(f"{self.port.name}: {len(self._buffer)} bytes without an answer")
            )
            return
        # An adapter that echoes delivers the question's own bytes first. They are an echo for sure
        # as soon as more follows, unless the device's answer may repeat the question.
        is_echo = self._buffer.startswith(question.data)
        if is_echo and not question.answer_repeats:
            if len(self._buffer) > len(question.data):
                self._answer.set_exception(DeviceRefusedError(f"{question.what}: {_ECHO}"))
            return
        # A whole answer ends the exchange. A wrong one is explained by its likeliest cause: an
        # echo, a late answer to an earlier question, else what the protocol found.
        try:
            answer = question.extract_answer(self._buffer)
        except LinkError as error:
            if question.data.startswith(self._buffer) and not is_echo:
                return  # it may be the beginning of an echo
            if is_echo or self._is_second_copy(self._buffer):
                self._answer.set_exception(DeviceRefusedError(f"{question.what}: {_ECHO}"))
            elif is_late:
                self._answer.set_exception(LinkError(f"{question.what}: {self._late.explain()}"))
            else:
                self._answer.set_exception(error)
        else:
            if answer is not None:
                self._answer.set_result(answer)

    def _is_second_copy(self, received_bytes: bytes) -> bool:
        """Whether these bytes answer a question that its own bytes had answered before."""
        return bool(self._repeated) and received_bytes.startswith(self._repeated)

    def _completes_abandoned(self, data: bytes) -> bool:
        """Whether these bytes complete the answer to an abandoned question; notes its delay."""
        # Each abandoned question collects the bytes for itself, oldest first, because a late answer
        # may come in pieces and across the next question.
        for abandoned in self._abandoned:
            abandoned.received_bytes = (abandoned.received_bytes + data)[-_EXTRA_BYTES_MAX:]
            try:
                answer = abandoned.question.extract_answer(abandoned.received_bytes)
            except LinkError:  # the answer to another one
                abandoned.received_bytes = b""
                continue
            if answer is not None:
                self._late.note_late(self._last_byte_s - abandoned.request_s)
                self._abandoned.remove(abandoned)
                return True
        return False

    def lost(self, error: LinkDownError) -> None:
        """The line is gone (called by the port)."""
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(error)
