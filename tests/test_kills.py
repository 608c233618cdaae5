"""Verbs that are killed, whose disk is full, or that write where another does; `benchmarks.kills` has all of them."""

from __future__ import annotations

import pytest

from benchmarks.kills import COMMANDS, after_a_kill, on_a_full_disk, undisturbed, with_another


def test_a_conversion_is_whole_or_not_there() -> None:
    command = COMMANDS["import"]
    whole = undisturbed(command)
    assert after_a_kill(command, whole, 0.8)[1] == ""
    assert with_another(command, whole) == ""


@pytest.mark.parametrize(("verb", "size"), [("import", 1000), ("init", 100), ("replay", 500)])
def test_a_full_disk_is_said(verb: str, size: int) -> None:
    assert on_a_full_disk(COMMANDS[verb], size) == ""
