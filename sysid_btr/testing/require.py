"""How a check says what is broken."""

from __future__ import annotations


def require(condition: bool, promise: str) -> None:
    """Raise AssertionError with the promise that was broken."""
    if not condition:
        raise AssertionError(promise)
