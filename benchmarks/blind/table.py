"""The table of outcomes: one row a log, appended as soon as the log is done."""

from __future__ import annotations

import csv
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One log. All columns are text or numbers that read back as themselves; see README.md."""

    id: str
    part: str
    series: int
    number: int
    code: str
    recipe: str
    robot: str
    motion: str
    seed: int
    effort: int
    planted: str
    verdict: str
    named: str
    correct: str
    why: str
    amplitude_error: str
    in_ci95: str
    chi2_before: str
    chi2_after: str
    signature: str
    signature_fits: str
    seconds: float
    replays: int
    family_correct: str = ""
    families: str = ""
    certainties: str = ""
    excess_gone: str = ""
    evidence: str = ""

    @property
    def key(self) -> tuple[str, str, str]:
        """What makes doing a log again pointless: the same log, the same recipe, the same code."""
        return self.id, self.recipe, self.code


NUMBERS: dict[str, type[int] | type[float]] = {
    "series": int,
    "number": int,
    "seed": int,
    "effort": int,
    "replays": int,
    "seconds": float,
}


def read_rows(path: Path) -> list[Row]:
    """All rows, none if there is no table.

    Raises
    ------
    ValueError
        If the columns are those of another version.
    """
    if not path.exists():
        return []
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        expected, found = [f.name for f in fields(Row)], list(reader.fieldnames or ())
        # older tables have not the last columns
        oldest = sum(f.default is MISSING for f in fields(Row))
        if len(found) < oldest or found != expected[: len(found)]:
            raise ValueError(f"{path} has other columns than {', '.join(expected)}; move it away or give --out")
        return [Row(**{k: NUMBERS.get(k, str)(v) for k, v in line.items()}) for line in reader]  # type: ignore[arg-type]


def append(path: Path, row: Row) -> None:
    """Add a row; several processes may share a table, and no interruption leaves half of it."""
    with _locked(path):
        write_rows(path, [*read_rows(path), row])


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Replace the table."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".part")
    try:
        with os.fdopen(handle, "w", newline="") as file:
            writer = csv.DictWriter(file, [f.name for f in fields(Row)])
            writer.writeheader()
            writer.writerows(asdict(row) for row in rows)
        Path(name).chmod(0o644)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    import fcntl

    path.parent.mkdir(parents=True, exist_ok=True)
    with (path.parent / f".{path.name}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
