"""Messages to a viewer."""

from typing import Literal

from nicegui import ui


def show_message(text: str, good: bool | None = None) -> None:
    """Show the viewer a message for some seconds, away from the stop button."""
    kind: Literal["positive", "negative"] | None = (
        None if good is None else "positive" if good else "negative"
    )
    ui.notify(text, type=kind, position="top", timeout=5000 if good is None else 8000)
