"""The table of outcomes: one row a parameter of a log, appended together as soon as the log is done."""

from __future__ import annotations

import csv
import fcntl
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

Key = tuple[str, str, str, int, str, str]


@dataclass(frozen=True)
class Row:
    """One parameter of one log.

    Attributes
    ----------
    robot, estimator, plant, number : which log, and what was done with it.
    motion, bits, noise : of the log.
    parameter, true, value, std, low, high : the 95 % interval, and what it should hold.
    identifiable, at_bound : what the result says.
    converged : of a posterior; 1 for least squares.
    chi2 : mean square of fitted error over noise floor.
    seconds : of the whole fit.
    recipe, code : what made the log, what fitted it.
    """

    robot: str
    estimator: str
    plant: str
    number: int
    motion: str
    bits: int
    noise: float
    parameter: str
    true: float
    value: float
    std: float
    low: float
    high: float
    identifiable: str
    at_bound: int
    converged: int
    chi2: float
    seconds: float
    recipe: str
    code: str

    @property
    def key(self) -> Key:
        """What makes doing a log again pointless."""
        return self.robot, self.estimator, self.plant, self.number, self.recipe, self.code

    @property
    def covered(self) -> bool:
        """Whether the interval holds the truth."""
        return self.low <= self.true <= self.high

    @property
    def width(self) -> float:
        return self.high - self.low


_TYPES = {"int": int, "float": float, "str": str}
COLUMNS = tuple(f.name for f in fields(Row))


def read_rows(path: Path) -> list[Row]:
    """All rows, none if there is no table.

    A log whose last lines a power cut has halved is left out, and is then done again.

    Raises
    ------
    ValueError
        If the columns are those of another version.
    """
    if not path.exists():
        return []
    with path.open(newline="") as file:
        lines = list(csv.reader(file))
    if lines and tuple(lines[0]) != COLUMNS:
        raise ValueError(f"{path} has other columns than {', '.join(COLUMNS)}; move it away or give --out")
    types = [_TYPES[str(f.type)] for f in fields(Row)]
    return [
        Row(**{name: make(text) for name, make, text in zip(COLUMNS, types, line, strict=True)})  # type: ignore[arg-type]
        for line in lines[1:]
        if len(line) == len(COLUMNS) and line[-1]
    ]


def append(path: Path, rows: Sequence[Row]) -> None:
    """Add the rows of one log, in one write; several processes may share a table."""
    from io import StringIO

    text = StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        whole = file.read()
        if not whole:
            writer.writeheader()
        elif not whole.endswith(b"\n"):  # a power cut left half a line
            text.write("\n")
        writer.writerows(asdict(row) for row in rows)
        file.write(text.getvalue().encode())
        file.flush()
        os.fsync(file.fileno())
