"""What is refused, with the way out."""

from __future__ import annotations

from typing import TypeVar

from ._reviv import Error

# Errors of a callback (`Stopped`) and of Python have no way out to give.
Error.help = ""

Kind = TypeVar("Kind", bound=Error)


class Absent(Error, AttributeError):
    """What was asked for is not part of this reconstruction."""


def refused(message: object, hint: str = "", kind: type[Kind] = Error) -> Kind:  # type: ignore[assignment]
    """An error that says this; ``hint`` is its way out."""
    error = kind(f"{message}\nhint: {hint}" if hint else str(message))
    error.help = hint
    return error
