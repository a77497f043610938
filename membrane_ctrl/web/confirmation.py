"""The dialog that asks whether to do something."""

from __future__ import annotations

from collections.abc import Sequence

from nicegui import ui


async def confirm(
    title: str,
    lines: Sequence[str] = (),
    yes: str = "Do it",
    colour: str = "primary",
    enter_confirms: bool = False,
) -> bool:
    """Show the dialog and return whether the viewer agrees.

    Parameters
    ----------
    title : str
        The question.
    lines : sequence of str
        What it does.
    yes : str
        Label of the button that agrees.
    colour : str
        Of that button.
    enter_confirms : bool
        Whether that button has the focus, else *Cancel*.
    """
    with ui.dialog() as dialog, ui.card():
        ui.label(title).classes("text-h6")
        for line in lines:
            ui.label(line)
        with ui.row():
            confirm_button = ui.button(yes, on_click=lambda: dialog.submit("yes")).props(
                f"color={colour}"
            )
            cancel = ui.button("Cancel", on_click=lambda: dialog.submit(""), color=None)
            cancel.props("flat")
            (confirm_button if enter_confirms else cancel).props("autofocus")
    answer = await dialog
    if not dialog.is_deleted:  # with the viewer
        dialog.delete()
    return bool(answer)
