"""A viewer of the page or a program: name and role."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from membrane_ctrl.controller.command import Role


@dataclass(frozen=True, slots=True)
class WebUser:
    """A viewer or a program: name and role."""

    name: str
    role: Role
    # with a password or a token; a link proves no name
    has_login: bool = field(default=False, compare=False)
    via: Literal["page", "token"] = "page"
