"""From recordings in their own words to one log of the schema: units, names, signs, episodes, metadata."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import LogError
from sysid_btr.io._clock import typical_interval
from sysid_btr.io._text import some
from sysid_btr.io.importers.base import Recording, Signal
from sysid_btr.io.importers.encoding import decode
from sysid_btr.io.importers.mapping import ImportMap, JointRule
from sysid_btr.io.importers.units import (
    NORMALISED,
    SI,
    Unit,
    group_of,
    is_joint_column,
    resolve,
    signed_with_joint,
    unwrapped,
)
from sysid_btr.io.log import Log, LogMeta, closest, is_schema_column

_RESERVED = ("time", "episode")
_REGULAR = 0.02
"""Share of the typical interval by which 95 % of the intervals may differ on a regular clock."""
_ANGLES = {"command": "rad", "position": "rad", "velocity": "rad/s", "effort": "Nm"}
"""Units that need no mention in the metadata."""
_LINEAR = {"command": "m", "position": "m", "velocity": "m/s", "effort": "N"}


@dataclass(frozen=True, eq=False)
class _Column:
    """A column of the schema as it will be written; how often its encoder passed the end of a turn."""

    values: FloatArray
    unit: str
    stated: bool
    passed: int = 0


def assemble(
    recordings: Sequence[Recording], told: ImportMap, sliding: Mapping[str, bool] | None = None
) -> tuple[Log, tuple[str, ...]]:
    """One log of all recordings; each is an episode, or as many as it says.

    Parameters
    ----------
    recordings : in the order wanted.
    told : what the user said.
    sliding : for each joint of the model, by the model's name, whether it slides; empty without a model.

    Returns
    -------
    log : in SI units, joints by the names wanted.
    remarks : what was assumed, one sentence each.

    Raises
    ------
    LogError
        If a joint that is to be renamed is not there, two columns end up as one, or a joint that slides is in
        degrees; all problems at once.
    """
    unmatched = list(_unmatched(recordings, told))
    problems = [] if told.partial else [f"--rename or [joints] {said}" for said in unmatched]
    parts: list[dict[str, _Column]] = []
    for recording in recordings:
        part: dict[str, _Column] = {}
        for signal in recording.signals:
            column = _renamed(signal.column, told)
            if column in part:
                problems.append(f"{recording.path}: {signal.source} is a second source of {column}")
                continue
            try:
                slides = (sliding or {}).get(column.partition(".")[2])
                part[column] = _converted(signal, column, told, slides, recording.episode)
            except LogError as error:
                problems.append(f"{recording.path}: {error}")
        parts.append(part)
    if problems:
        raise LogError("\n".join(problems))
    counts = [len(recording.time) for recording in recordings]
    names = list(dict.fromkeys(name for part in parts for name in part))
    channels = {
        name: np.concatenate(
            [part[name].values if name in part else np.full(n, np.nan) for part, n in zip(parts, counts, strict=True)]
        ).astype(np.float64)
        for name in names
    }
    meta, remarks = _meta(recordings, told, _units(parts, told))
    foreign, renamed = _foreign(recordings, counts, set(names))
    log = Log(
        time=np.concatenate([r.time for r in recordings]).astype(np.float64),
        channels=channels,
        meta=meta,
        episode=_episodes(recordings),
        unknown=foreign,
    )
    if meta.sample_period is None:
        log = replace(log, meta=replace(meta, sample_period=_period(log)))
    unused = [f"[joints] {said}" for said in unmatched]
    return log, (*remarks, *_turns(parts), *renamed, *unused)


def _unmatched(recordings: Sequence[Recording], told: ImportMap) -> Iterator[str]:
    """Joints that the user speaks of and no recording has."""
    there = dict.fromkeys(
        s.column.partition(".")[2] for r in recordings for s in r.signals if not s.column.startswith("imu.")
    )
    for name in told.joints:
        if name not in there:
            guess = closest(name, there)
            hint = f"did you mean {guess}? " if guess else ""
            yield f"{name}: no such name; {hint}available: {some(there, 30)}"


def _renamed(column: str, told: ImportMap) -> str:
    channel, _, name = column.partition(".")
    rule = told.joints.get(name)
    return column if channel == "imu" or rule is None or rule.to is None else f"{channel}.{rule.to}"


def _turns(parts: Sequence[Mapping[str, _Column]]) -> Iterator[str]:
    """What was done where an encoder passed the end of its turn."""
    passed = [name for part in parts for name, column in part.items() if column.passed]
    if passed:
        yield (
            f"jumps of more than half a turn are taken for an encoder that passed the end of its turn, and counted on: "
            f"{some(dict.fromkeys(passed), 8)}; commands are taken as they are"
        )


def _raw(signal: Signal, column: str, told: ImportMap) -> FloatArray:
    """Values as the source means them: with their sign, NaN where there is none."""
    values = np.asarray(signal.values, dtype=np.float64)
    absent = told.absent(column, signal.column)
    if absent:
        values = np.where(np.any(np.isclose(values[:, None], absent, rtol=1e-6, atol=0), axis=1), np.nan, values)
    encoding = told.encoded(column, signal.column)
    return values if encoding is None else decode(values, encoding)


def _continued(values: FloatArray, turn: float, episode: IntArray | None) -> tuple[FloatArray, int]:
    """Counts of a turn counted on past its end, in each episode; and how often they passed it."""
    if episode is None:
        return unwrapped(values, turn)
    result, passed = values.copy(), 0
    for number in np.unique(episode):
        result[episode == number], more = unwrapped(values[episode == number], turn)
        passed += more
    return result, passed


def _converted(
    signal: Signal, column: str, told: ImportMap, slides: bool | None, episode: IntArray | None = None
) -> _Column:
    """Values in the unit of the schema, with the joint's sign and offset; `slides` is None where not known."""
    group = group_of(column)
    source = signal.column.partition(".")[2]
    rule = told.joints.get(source, JointRule()) if is_joint_column(column) else JointRule()
    said = told.unit(column, signal.column)
    text = signal.unit if said is None else said
    usual = _LINEAR[group] if slides and group in _LINEAR else SI[group][0]
    if isinstance(text, str) and text in NORMALISED:
        unit = _share_of_range(text, source, rule, usual)
    elif text is None:
        unit = Unit(usual)
    elif isinstance(text, str):
        unit = resolve(text, group)
    else:
        unit = Unit(usual, text)
    wrong = None if slides is None else (_ANGLES if slides else _LINEAR).get(group)
    if unit.si == wrong:
        raise LogError(
            f"{column} is given in {text}, but the joint {'slides' if slides else 'turns'} in the model: "
            f"give it its own unit by --unit {column}=UNIT"
        )
    values, passed = _raw(signal, column, told), 0
    if unit.turn and group == "position":
        values, passed = _continued(values, unit.turn, episode)
    values = unit.convert(values)
    if rule.sign < 0 and signed_with_joint(column):
        values = -values
    if rule.offset and group in ("command", "position") and unit.si in ("rad", "m"):
        values = values + rule.offset
    stated = any(key in told.units for key in (column, signal.column))
    return _Column(values, unit.si, stated, passed)


def _share_of_range(text: str, name: str, rule: JointRule, si: str) -> Unit:
    """Normalised positions: the ends of the scale are those of the joint's calibrated range."""
    if rule.range is None:
        raise LogError(
            f"{name} is normalised ({text}): state its range in a mapping file: "
            f"[joints.{name}] range = [low, high], rad"
        )
    low, high = NORMALISED[text]
    factor = (rule.range[1] - rule.range[0]) / (high - low)
    return Unit(si, factor, rule.range[0] - factor * low)


def _units(parts: Sequence[Mapping[str, _Column]], told: ImportMap) -> dict[str, str]:
    """Units for the metadata: where they are not the usual ones, or where the user insists."""
    units: dict[str, str] = {}
    columns = {name: column for part in parts for name, column in part.items()}
    for channel, usual in _ANGLES.items():
        own = {name: c.unit for name, c in columns.items() if name.startswith(f"{channel}.")}
        if len(set(own.values())) == 1 and usual not in own.values():
            units[channel] = next(iter(own.values()))
            continue
        units |= {name: unit for name, unit in own.items() if unit != usual}
    units |= {name: c.unit for name, c in columns.items() if c.stated and group_of(name) in _ANGLES}
    return units


def _meta(recordings: Sequence[Recording], told: ImportMap, units: Mapping[str, str]) -> tuple[LogMeta, list[str]]:
    """What the recordings say of themselves, and what the user says on top."""
    first = recordings[0].meta
    given = told.meta.model_dump(exclude_none=True)
    remarks = []
    already_a_log = bool(first.source)
    if "mount" not in given and not already_a_log:
        remarks.append('the base is assumed fixed (mount "fixed"); for a floating base: --mount free')
    periods = {r.meta.sample_period for r in recordings}
    meta = replace(first, sample_period=periods.pop() if len(periods) == 1 else None, units={**first.units, **units})
    notes = [*(r.meta.notes for r in recordings), given.pop("notes", "")]
    return replace(meta, **given, notes="; ".join(dict.fromkeys(n for n in notes if n))), remarks


def _period(log: Log) -> float | None:
    """Nominal period of a regular clock, s."""
    steps = np.concatenate([np.diff(log.time[rows]) for rows in log.episodes()])
    interval = typical_interval(log.time)
    if not len(steps) or not np.isfinite(interval):
        return None
    regular = np.abs(steps / interval - 1) < _REGULAR
    # the mean, because stamps since 1970 are rounded to a fraction of a microsecond
    return float(f"{np.mean(steps[regular]):.6g}") if np.mean(regular) > 0.95 else None


def _episodes(recordings: Iterable[Recording]) -> IntArray:
    parts: list[IntArray] = []
    begin = 0
    for recording in recordings:
        own = recording.episode
        numbers = np.zeros(len(recording.time), dtype=np.int64) if own is None else own
        if parts:
            numbers = numbers - (int(numbers.min()) if len(numbers) else 0)
        parts.append(numbers + (begin if parts else 0))
        begin = int(parts[-1].max()) + 1 if len(parts[-1]) else begin
    return np.concatenate(parts)


def _foreign(
    recordings: Sequence[Recording], counts: Sequence[int], taken: set[str]
) -> tuple[dict[str, np.ndarray[Any, Any]], list[str]]:
    """Columns that were not understood, under their own names but for those the schema has."""
    foreign: dict[str, np.ndarray[Any, Any]] = {}
    remarks: list[str] = []
    for name in dict.fromkeys(name for r in recordings for name in r.foreign):
        pieces = [r.foreign.get(name) for r in recordings]
        if any(p is not None and p.dtype == object for p in pieces):
            filled = [np.full(n, None) if p is None else p.astype(object) for p, n in zip(pieces, counts, strict=True)]
        else:
            filled = [np.full(n, np.nan) if p is None else p for p, n in zip(pieces, counts, strict=True)]
        own = name
        if name in _RESERVED or name in taken or is_schema_column(name):
            own = f"foreign.{name}"
            remarks.append(f"{name} is a name of the schema, so the file's column of that name is kept as {own}")
        foreign[own] = np.concatenate(filled)
    return foreign, remarks
