"""Results as HTML for a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from io import StringIO
from typing import Any

from sysid_btr.display.text import PLAIN_WIDTH, show

FRAME = '<pre style="white-space:pre;overflow-x:auto;line-height:1.25;font-family:monospace">{code}</pre>'


def result_html(result: Mapping[str, Any]) -> str:
    """The tables of the command line, from the content of result.json."""
    from rich.console import Console

    # in a notebook rich would show the tables by itself, too
    out = Console(
        file=StringIO(), record=True, width=PLAIN_WIDTH, force_jupyter=False, highlight=False, emoji=False, markup=False
    )
    show(result, out)
    return out.export_html(inline_styles=True, code_format=FRAME)


def facts_html(title: str, facts: Mapping[str, str]) -> str:
    """A table of names and texts."""
    body = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(text)}</td></tr>'
        for name, text in facts.items()
    )
    return f"<table><caption>{escape(title)}</caption>{body}</table>"
