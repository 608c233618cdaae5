"""Importing the package costs next to nothing, and what is slow is loaded when it is used."""

from __future__ import annotations

import subprocess
import sys

import pytest

import sysid_btr

SLOW = ("mujoco", "scipy", "pandas", "pyarrow", "matplotlib", "pydantic", "numpy")


def test_help_lists_the_verbs_and_imports_nothing_slow() -> None:
    code = (
        "import atexit, sys; from sysid_btr.cli import main; sys.argv = ['sysid-btr', '--help']; "
        f"atexit.register(lambda: print('imported:', *(m for m in {SLOW!r} if m in sys.modules))); main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    verbs = done.stdout.partition("Commands:")[2].partition("Exit codes:")[0]
    assert "close" in verbs
    assert "..." not in verbs, "what a verb does fits the line of a narrow terminal"
    assert done.stdout.splitlines()[-1] == "imported:"


@pytest.mark.parametrize("module", ["sysid_btr", "sysid_btr.cli"])
def test_nothing_slow_is_imported(module: str) -> None:
    code = f"import sys, {module}; print(' '.join(m for m in {SLOW!r} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("name", sysid_btr.__all__)
def test_every_public_name_loads(name: str) -> None:
    assert callable(getattr(sysid_btr, name))
    assert name in dir(sysid_btr)


def test_an_unknown_name_says_what_there_is() -> None:
    with pytest.raises(AttributeError, match="read_log"):
        sysid_btr.read_logs  # noqa: B018
