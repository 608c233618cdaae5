"""What is said at the terminal: results to stdout, progress and remarks to stderr."""

from __future__ import annotations

import sys
from typing import Any

from sysid_btr.display.printable import printable


def remark(text: str) -> None:
    """Tell the user something that is no result."""
    sys.stderr.write(printable(text) + "\n")
    sys.stderr.flush()


def print_json(content: Any) -> None:
    """A result for programs."""
    from sysid_btr.result import to_json

    sys.stdout.write(to_json(content))


def print_result(result: dict[str, Any], as_json: bool) -> None:
    """A result for people, or for programs."""
    if as_json:
        print_json(result)
        return
    from sysid_btr.display.text import console, show

    show(result, console(sys.stdout))
