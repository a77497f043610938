"""`membrane-ctrl serve token`: makes, lists and removes the tokens of programs."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Tokens for programs, which send them as `Authorization: Bearer TOKEN`.",
)


@app.command("add")
def add_token(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the program.")],
    role: Annotated[str, typer.Argument(metavar="ROLE", help="read, operate or tune.")],
) -> None:
    """Make a token and print it; it cannot be shown again."""
    from membrane_ctrl.service import tokens

    print(tokens.add_token(tokens.tokens_file(), name, role))


@app.command("list")
def list_tokens() -> None:
    """List the tokens of this user's services: name and role."""
    from membrane_ctrl.service.tokens import read_tokens, tokens_file

    for each in read_tokens(tokens_file()):
        print(f"{each.name}  {each.role}")


@app.command("revoke")
def revoke_token(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the program.")],
) -> None:
    """Remove a token: the next request with it is refused."""
    from membrane_ctrl.service import tokens

    tokens.revoke_token(tokens.tokens_file(), name)
    print(f"{name}: revoked", file=sys.stderr)
