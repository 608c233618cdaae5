"""Templates of HTML pages, in one style."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment

STYLE = Path(__file__).parent
"""Where page.css is, which every page includes."""


def templates(folder: Path) -> Environment:
    """The templates in a folder; what they are given is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    made = Environment(
        loader=FileSystemLoader([folder, STYLE]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["typeset"] = typeset
    return made


def typeset(text: str) -> str:
    """With signs that a terminal may not have."""
    return text.replace("+-", "±").replace("->", "→").replace(" .. ", " … ")
