"""What the guide says of a verdict, for a page that must work without the guide."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html import escape
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
PLACES = (PACKAGE / "guide" / "verdicts.md", PACKAGE.parent / "docs" / "guide" / "verdicts.md")
"""Of an installed package, and of a checkout."""
MARKS = (
    (r"\[([^]]*)\]\([^)]*\)", r"\1"),
    (r"`([^`]*)`", r"<code>\1</code>"),
    (r"\*\*([^*]*)\*\*", r"<b>\1</b>"),
    (r"\*([^*]*)\*", r"<i>\1</i>"),
)
"""The Markdown that these sections use, and HTML for it; links lead to pages that are not there."""


def about_verdict(verdict: str) -> str:
    """The guide's section on a verdict as HTML; empty where there is none."""
    file = next((place for place in PLACES if place.is_file()), None)
    if file is None or not verdict:
        return ""
    found = re.search(rf"^## `{re.escape(verdict)}`\n(.*?)(?=^#)", file.read_text(encoding="utf-8"), re.M | re.S)
    return "".join(_html(found.group(1))) if found else ""


def _html(section: str) -> Iterator[str]:
    for block in re.split(r"\n\s*\n", section.strip()):
        text = escape(block, quote=False)
        for mark, html in MARKS:
            text = re.sub(mark, html, text)
        if text.startswith("|"):
            rows = [line.strip("|").split("|") for line in text.splitlines() if line.strip("|- ")]
            cells = ("".join(f"<td>{cell.strip()}</td>" for cell in row) for row in rows)
            yield f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"
        else:
            yield f"<p>{text}</p>"
