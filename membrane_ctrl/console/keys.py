"""The console's dialogue with the operator: keys in, requests and the last line out."""

from __future__ import annotations

from concurrent.futures import Future

from membrane_ctrl.console.requests import Request, Send

_MARK_MAX = 200  # characters; the port takes 500 bytes
HELP = (
    ("h", "hold: start to hold, or return to holding", "hold"),
    ("p", "pause the loop at the pump's mean flow; p again resumes", "pause"),
    ("m", "mark: add a remark to the timeline", 'mark "text"'),
    ("s", "stop: end the run safely, after a confirmation", "stop"),
    ("?", "show or hide this help", ""),
)
_FOOT = "h hold  p pause/resume  m mark  s stop  ? help"
_SUSPENDED = "Ctrl-Z does nothing here: a suspended hold would lose the mirror; s stops the run"


class Desk:
    """The dialogue with the operator: keys in, requests and the console's last line out."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._prompt = ""  # "mark" or "stop" while it waits for an answer
        self._text = ""
        self._status_line = ""
        self._answer: Future[str] | None = None
        self.help = False

    @property
    def is_asking(self) -> bool:
        """Whether the last line waits for the operator."""
        return bool(self._prompt)

    @property
    def bottom_line(self) -> str:
        """The console's last line."""
        if self._answer is not None and self._answer.done():
            self._status_line = self._answer.result()
            self._answer = None
        match self._prompt:
            case "mark":
                return f"mark: {self._text}▏ (Enter sends, Esc cancels)"
            case "stop":
                return "stop the run? y: yes, any other key: no"
        if not self._status_line:
            return _FOOT
        return f"{self._status_line}   · {_FOOT}"

    def process_keys(self, text: str, paused: bool) -> None:
        """Take what was typed, in the loop that draws the console.

        Of several characters at once only the first is a command: the rest may be a paste.

        Parameters
        ----------
        text : str
            All characters since the last call; empty if there were none.
        paused : bool
            Whether the hold is paused now: the key `p` then resumes.
        """
        if not text:
            return
        if self._prompt == "mark":
            self._write_text(text)
        elif self._prompt == "stop":
            self._prompt = ""
            if text[0] in "yY":
                self._send_request({"do": "stop"})
            else:
                self._status_line = "not stopped"
        else:
            self._run_command(text[0].lower(), paused)

    def _run_command(self, key: str, paused: bool) -> None:
        """Execute the command of a key; other keys do nothing."""
        match key:
            case "h":
                self._send_request({"do": "hold"})
            case "p":
                self._send_request({"do": "resume" if paused else "pause"})
            case "m":
                self._prompt = "mark"
                self._text = ""
            case "s":
                self._prompt = "stop"
            case "?":
                self.help = not self.help
            case "\x1a":
                self._status_line = _SUSPENDED

    def _write_text(self, text: str) -> None:
        for letter in text:
            if letter in "\r\n":
                self._prompt = ""
                if self._text.strip():
                    self._send_request({"do": "mark", "text": self._text.strip()})
                return
            if letter == "\x1b":
                self._prompt = ""
                return
            if letter in "\x7f\b":
                self._text = self._text[:-1]
            elif letter.isprintable():
                self._text = (self._text + letter)[:_MARK_MAX]

    def _send_request(self, request: Request) -> None:
        self._status_line = f"{request['do']}: waiting for the answer"
        self._answer = self._send(request)
