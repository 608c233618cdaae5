"""Text of others, such as names in a log, made safe for a terminal."""

from __future__ import annotations

import re

CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""Characters that a terminal obeys; not tab and line feed."""


def printable(text: str) -> str:
    """The text with characters that a terminal obeys as escapes."""
    return CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)
