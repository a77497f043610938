"""Messages to a viewer."""

from typing import Literal

from nicegui import ui

# above the stop button, and far from the state at the top
MESSAGE_CSS = ".membrane-message { margin-bottom: 4.5rem }"


def show_message(text: str, good: bool | None = None) -> None:
    """Show the viewer a message for some seconds, away from the state and the stop button.

    Parameters
    ----------
    text : str
        One sentence.
    good : bool, optional
        Green for a success, red for a failure, which stays longer; grey if it is neither.
    """
    kind: Literal["positive", "negative"] | None = None
    timeout_ms = 5000
    if good is not None:
        kind = "positive" if good else "negative"
        timeout_ms = 8000
    ui.notify(text, type=kind, position="bottom", timeout=timeout_ms, classes="membrane-message")
