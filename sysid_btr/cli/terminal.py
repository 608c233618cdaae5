"""What is said at the terminal: results to stdout, progress and remarks to stderr."""

from __future__ import annotations

import json
import os
import sys
from io import FileIO, TextIOWrapper
from typing import Any

from sysid_btr.display.printable import printable
from sysid_btr.reading import parse_json


def open_streams() -> None:
    """Make output streams take whatever is written: closed ones swallow it, and letters they lack become escapes."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, TextIOWrapper(FileIO(os.devnull, "w")))
        elif isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def hang_up() -> None:
    """Let nobody write to a pipe that nobody reads."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)


def remark(text: str) -> None:
    """Tell the user something that is no result."""
    sys.stderr.write(printable(text) + "\n")
    sys.stderr.flush()


def print_json(content: Any) -> None:
    """A result for programs."""
    from sysid_btr.result import to_json

    text = to_json(content)
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:  # of a terminal that knows other letters; JSON has escapes of its own
        text = json.dumps(parse_json(text), indent=2) + "\n"
    sys.stdout.write(text)


def print_result(result: dict[str, Any], as_json: bool, *, explain: bool = False) -> None:
    """A result for people, or for programs."""
    if as_json:
        print_json(result)
        return
    from sysid_btr.display.text import console, show

    show(result, console(sys.stdout), explain=explain)
