"""Importing the package costs next to nothing, and what is slow is loaded when it is used."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

import sysid_btr

SLOW = ("mujoco", "scipy", "pandas", "pyarrow", "matplotlib", "pydantic", "numpy")


def test_import_takes_less_than_300_ms() -> None:
    code = "import time; t = time.perf_counter(); import sysid_btr; print(time.perf_counter() - t)"
    times = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout)
        for _ in range(3)
    ]
    assert min(times) < 0.3


def test_help_takes_less_than_500_ms() -> None:
    code = "import sys; from sysid_btr.cli import main; sys.argv = ['sysid-btr', '--help']; main()"
    times = []
    for _ in range(3):
        began = time.perf_counter()
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        times.append(time.perf_counter() - began)
        assert done.returncode == 0, done.stderr
        verbs = done.stdout.partition("Commands:")[2].partition("Exit codes:")[0]
        assert "close" in verbs
        assert "..." not in verbs, "what a verb does fits the line of a narrow terminal"
    assert min(times) < 0.5


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
