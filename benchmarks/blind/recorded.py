"""Logs on disk with their truth: made once, where Pinocchio is; read wherever `close` runs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.blind.draw import BENCHES, MODELS, SAMPLE_LOGS, Bench, draw
from reference_simulator import EFFECTS, FORMS

if TYPE_CHECKING:
    from reference_simulator.effects import Effect

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LOGS = HERE / "logs"
PACKING = 19
"""Level of zstandard."""


@dataclass(frozen=True)
class Recorded:
    """A log and what was planted in it.

    Attributes
    ----------
    id, series, part, number : which one.
    bench : robot.
    motion, seed, effort : of the recording; whether torques are logged.
    effects : planted, at names.
    path : of the Parquet file.
    """

    id: str
    series: int
    part: str
    number: int
    bench: Bench
    motion: str
    seed: int
    effort: bool
    effects: tuple[Effect, ...]
    path: Path


def identify(part: str, number: int, series: int) -> str:
    """The name of a log."""
    return f"{f'{series}/' if series else ''}{part}-{number:02d}"


def path_of(part: str, number: int, series: int) -> Path:
    """Where a log is, once it is recorded."""
    return LOGS / recipe_state(part) / f"{identify(part, number, series).replace('/', '_')}.parquet"


def is_recorded(part: str, number: int, series: int) -> bool:
    return path_of(part, number, series).with_suffix(".truth.json").exists()


def record(part: str, number: int, series: int) -> Recorded:
    """Draw a log and record it, unless that is done."""
    from reference_simulator.record import record as run

    path = path_of(part, number, series)
    if not is_recorded(part, number, series):
        path.parent.mkdir(parents=True, exist_ok=True)
        case = draw(part, number, series)
        log, truth = run(case.spec)
        truth["case"] = {"bench": case.bench.name, "effort": case.spec.sensors.effort, "draws": case.draws}
        _write_small(log, path)
        path.with_suffix(".truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return read(part, number, series)


def read(part: str, number: int, series: int) -> Recorded:
    """A log that is recorded; needs no Pinocchio."""
    path = path_of(part, number, series)
    truth = json.loads(path.with_suffix(".truth.json").read_text())
    return Recorded(
        id=identify(part, number, series),
        series=series,
        part=part,
        number=number,
        bench=BENCHES[truth["case"]["bench"]],
        motion=truth["motion"],
        seed=truth["seed"],
        effort=truth["case"]["effort"],
        effects=tuple(_effect(e) for e in truth["effects"]),
        path=path,
    )


def _effect(entry: dict[str, Any]) -> Effect:
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in entry["parameters"].items()}
    return (EFFECTS | FORMS)[entry["effect"]](where=tuple(entry["where"]), **values)


def _write_small(log: Any, path: Path) -> None:
    """Single precision is a thousand times finer than an encoder's count."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from sysid_btr.io.parquet import write_log

    write_log(log, path, overwrite=True)
    table = pq.read_table(path)
    small = [f if f.name in ("time", "episode") else f.with_type(pa.float32()) for f in table.schema]
    counted = [f.name for f in small if f.name.startswith("position.")]
    smooth = [f.name for f in small if f.name not in counted]
    pq.write_table(
        table.cast(pa.schema(small, metadata=table.schema.metadata)),
        path,
        compression="zstd",
        compression_level=PACKING,
        use_dictionary=counted,
        use_byte_stream_split=smooth,
        write_statistics=False,
    )


def recipe_state(part: str) -> str:
    """Digest of what makes the logs of a part."""
    simulator = [f for f in sorted((ROOT / "reference_simulator").glob("*.py")) if f.name != "forms.py"]
    sources = [HERE / "draw.py", HERE / "sizes.py", *simulator, SAMPLE_LOGS / "nao.xml", SAMPLE_LOGS / "leg.xml"]
    if part == "shape":
        sources += [HERE / "shapes.py", ROOT / "reference_simulator" / "forms.py", *sorted(MODELS.glob("*.xml"))]
    return digest(sources)


def digest(files: Sequence[Path]) -> str:
    """Of the content of some files."""
    whole = hashlib.sha256()
    for file in files:
        whole.update(file.read_bytes())
    return whole.hexdigest()[:8]
