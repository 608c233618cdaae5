"""An importer from another package: one file, and `import` reads its format as it reads the built-in ones."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from sysid_btr.errors import LogError
from sysid_btr.io.importers import ImportMap, Recording, Signal, available, import_log
from sysid_btr.io.importers.registry import ENTRY_POINTS, recognise
from sysid_btr.testing import check_importer

LINE = re.compile(rb"At ([\d.]+) s (\w+) was told ([-\d.]+) deg and stood at ([-\d.]+) deg\.")


@dataclass(frozen=True)
class Diary:
    """Sentences, one a sample."""

    name: str = "diary"
    title: str = "a diary"

    def recognises(self, path: Path, head: bytes) -> bool:
        return head.startswith(b"Dear diary")

    def read(self, path: Path, told: ImportMap) -> Recording:
        entries = LINE.findall(path.read_bytes())
        if not entries:
            raise LogError(
                f"{path}: a diary without an entry such as 'At 0.02 s knee was told 3 deg and stood at 2 deg.'"
            )
        time, _, sent, found = (np.array(column) for column in zip(*entries, strict=True))
        joint = entries[0][1].decode()
        signals = (
            Signal("told", f"command.{joint}", sent.astype(float), "deg"),
            Signal("stood at", f"position.{joint}", found.astype(float), "deg"),
        )
        return Recording(path, time.astype(float), signals, remarks=("The diary's handwriting was legible.",))


@pytest.fixture
def diary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    entry = EntryPoint("diary", f"{__name__}:Diary", ENTRY_POINTS)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda *, group: [entry] if group == ENTRY_POINTS else [])
    path = tmp_path / "monday"
    angle = 20 * np.sin(0.1 * np.arange(401) - 0.1)
    lines = (
        f"At {0.02 * i:.2f} s knee was told {angle[i + 1]:.6f} deg and stood at {angle[i]:.6f} deg." for i in range(400)
    )
    path.write_text("Dear diary\n" + "\n".join(lines))
    return path


def test_it_keeps_the_contract(diary: Path) -> None:
    check_importer(Diary(), diary)


def test_import_finds_it_and_converts_what_it_reads(diary: Path) -> None:
    assert "diary" in available()
    assert recognise(diary).name == "diary"
    imported = import_log([diary])
    assert imported.log.joints("position") == ("knee",)
    assert imported.log.channels["command.knee"] == pytest.approx(
        np.radians(20 * np.sin(0.1 * np.arange(400))), abs=1e-7
    )
    assert imported.log.meta.sample_period == pytest.approx(0.02)
    assert "The diary's handwriting was legible." in imported.remarks


class Careless(Diary):
    """Returns an empty recording where it understands nothing."""

    def read(self, path: Path, told: ImportMap) -> Recording:
        entries = LINE.findall(path.read_bytes())
        return super().read(path, told) if entries else Recording(path, np.zeros(0), ())


class Greedy(Diary):
    """Takes everything for its own."""

    def recognises(self, path: Path, head: bytes) -> bool:
        return True


@pytest.mark.parametrize(("broken", "promise"), [(Careless(), r"cut to 0\.1%"), (Greedy(), "takes for its own")])
def test_the_kit_finds_what_is_broken(diary: Path, broken: Diary, promise: str) -> None:
    with pytest.raises(AssertionError, match=promise):
        check_importer(broken, diary)
