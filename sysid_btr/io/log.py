"""A log in memory: what one robot was told and what its sensors said, one row a sample."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import LogError
from sysid_btr.io.frames import CLOCK, numbers, seconds, with_time
from sysid_btr.units import si

if TYPE_CHECKING:
    import pandas as pd

T = TypeVar("T")

SINCE_1970 = (9e8, 9e9)
"""s; a clock whose origin is between these, in the years 1998 to 2255, counts from 1970."""

ATTRIBUTE = "sysid_btr"
"""Key of the metadata in a DataFrame's ``attrs``, as in a file."""

SCHEMA_VERSION = 1

COMMANDS = ("command", "command_velocity", "command_effort")
"""Channels of what joints are told: the first by itself, the others alone or fed forward beside it."""

JOINT_CHANNELS = (
    *COMMANDS,
    "position",
    "velocity",
    "effort",
    "current",
    "voltage",
    "duty",
    "temperature",
    "stiffness",
    "enabled",
)
"""Channels that hold one column a joint."""

IMU_NAMES = ("gyro_x", "gyro_y", "gyro_z", "acc_x", "acc_y", "acc_z", "angle_x", "angle_y")
"""Names of the ``imu`` channel."""

CHANNELS = (*JOINT_CHANNELS, "imu", "force")
"""Every channel of the schema; a column is ``<channel>.<name>``."""

MOTION = "designed motion"
"""`LogMeta.source` of commands that are to be played, and that nobody has recorded yet."""


@dataclass(frozen=True)
class LogMeta:
    """What a log says about itself (the JSON under the file's ``sysid_btr`` metadata key).

    Attributes
    ----------
    schema : int
        Version of the log schema; this release reads version 1.
    robot : str
        Name of the robot.
    mount : {"fixed", "free"}
        Whether the torso was held or free to move.
    sample_period : float or None
        Nominal sampling period, s; None for an irregular clock.
    source : str
        Where the numbers come from, e.g. ``"measured"``; `MOTION` for commands that are to be played.
    command_hold : {"zoh", "linear"}
        What the robot does with a command between two samples.
    servo_period : float or None
        Period of the servo's control law, s.
    units : mapping of str to str
        Unit by channel (``"position"``) or by column (``"position.slider"``); SI where silent.
    drive : {"", "position", "velocity", "torque", "mixed", "none"}
        What commands are; as the model's actuators say where it is silent. "none": they drive nothing.
    command_space : {"joint", "ctrl"}
        Whether ``command.<joint>`` is in units of the joint, or MuJoCo's ctrl.
    torque_constant : float or mapping of str to float
        Torque per ampere, Nm/A (N/A), of all joints or by joint: makes torques of logged currents.
    at : mapping of str to float, or str
        Where joints stand that are not logged, rad or m by joint, or ``"keyframe:NAME"`` of the model.
    noise : mapping of str to float
        Standard deviation of a sensor's noise, SI, by channel or by column, where it is known; else it is read from the
        log.
    recorded : str
        When it was recorded, ISO 8601, e.g. ``"2026-11-23T14:05:00+00:00"``.
    notes : str
        Free text.
    extra : mapping
        Keys this release does not know; kept and written back.
    """

    schema: int = SCHEMA_VERSION
    robot: str = ""
    mount: Literal["fixed", "free"] = "fixed"
    sample_period: float | None = None
    source: str = ""
    command_hold: Literal["zoh", "linear"] = "zoh"
    servo_period: float | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    drive: str = ""
    command_space: Literal["joint", "ctrl"] = "joint"
    torque_constant: float | Mapping[str, float] | None = None
    at: Mapping[str, float] | str = ""
    noise: Mapping[str, float] = field(default_factory=dict)
    recorded: str = ""
    notes: str = ""
    extra: Mapping[str, Any] = field(default_factory=dict)

    def stated_noise(self, column: str) -> float | None:
        """Stated standard deviation of a column's noise: its own entry, else its channel's, else None."""
        return self.noise.get(column, self.noise.get(column.partition(".")[0]))

    def unit(self, column: str) -> str | None:
        """Declared unit of a column: its own entry, else its channel's, else None.

        For the IMU the entry ``"imu.gyro"`` stands for its three axes.
        """
        channel, _, name = column.partition(".")
        group = f"imu.{name.partition('_')[0]}" if channel == "imu" else channel
        return next((self.units[key] for key in (column, group) if key in self.units), None)


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """Samples of one recording (or of several, told apart by `episode`).

    Attributes
    ----------
    time : ndarray, shape (n,)
        Time of each sample as recorded, s, of any origin.
    channels : mapping of str to ndarray, shape (n,)
        Columns of the schema by full name (``"position.HeadYaw"``), SI units, in column order.
        NaN is a missing value; booleans are 0 and 1.
    meta : LogMeta
        What the log says about itself.
    episode : ndarray of int, shape (n,)
        Episode of each sample; zeros when the log has no such column.
    path : Path or None
        The file the log was read from.
    unknown : mapping of str to ndarray, shape (n,)
        Columns that are not of the schema; kept, ignored and written back.

    Raises
    ------
    LogError
        If columns differ in length.
    """

    time: FloatArray
    channels: Mapping[str, FloatArray]
    meta: LogMeta
    episode: IntArray
    path: Path | None = None
    unknown: Mapping[str, np.ndarray[Any, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.time)
        columns: dict[str, Any] = {"episode": self.episode, **self.channels, **self.unknown}
        wrong = {name: np.shape(values) for name, values in columns.items() if np.shape(values) != (n,)}
        if wrong:
            listing = ", ".join(f"{name} {shape}" for name, shape in wrong.items())
            raise LogError(f"every column of a log has one value a sample, here ({n},); found {listing}")

    def __len__(self) -> int:
        return len(self.time)

    @classmethod
    def from_pandas(cls, table: pd.DataFrame, meta: LogMeta | None = None) -> Log:
        """A log of a DataFrame with the schema's columns; `sysid_btr.import_log` takes other names and units.

        Parameters
        ----------
        table : DataFrame
            Time (s, timestamps or timedeltas) as the index or as column ``time``; then ``command.<joint>``,
            ``position.<joint>``, ...; ``episode`` where there are several.
        meta : LogMeta, optional
            What is known of it; else what `to_pandas` left in ``table.attrs``, else the defaults.

        Raises
        ------
        LogError
            If there is no time, or a column of the schema holds no numbers; all problems at once.
        """
        table = with_time(table)
        columns = {str(name): table.iloc[:, i] for i, name in enumerate(table.columns)}
        known = {name: numbers(column) for name, column in columns.items() if is_schema_column(name)}
        clock = seconds(columns[CLOCK]) if CLOCK in columns and len(table) else None
        episode = numbers(columns["episode"]) if "episode" in columns else np.zeros(len(table))
        problems = [
            f"{name} ({columns[name].dtype}) holds no numbers" for name, found in known.items() if found is None
        ]
        if len(columns) < table.shape[1]:
            problems.append("two columns have one name")
        if clock is None or not np.isfinite(clock).all():
            problems.append(f"no time: give seconds, timestamps or durations as column {CLOCK!r} or as the index")
        if episode is None or not np.array_equal(episode, np.round(episode)):
            problems.append("episode: number the episodes 0, 1, 2, ...")
        if problems or clock is None or episode is None:
            raise LogError(
                f"the DataFrame is not a log: {'; '.join(problems)}. Its columns: {', '.join(columns) or 'none'}. "
                "A table with names or units of its own is read by sysid_btr.import_log"
            )
        if meta is None:
            meta = meta_of_json(table.attrs.get(ATTRIBUTE, {}))
        channels = {name: found for name, found in known.items() if found is not None}
        unknown = {n: c.to_numpy() for n, c in columns.items() if n not in (*known, CLOCK, "episode")}
        channels |= torques_of_currents(channels, meta)
        return cls(clock, channels, meta, episode.astype(np.int64), unknown=unknown)

    def to_pandas(self) -> pd.DataFrame:
        """The samples as a DataFrame: index ``time`` (s), one column a channel, ``episode`` where there are several.

        Its ``attrs`` hold the metadata, so that `from_pandas` gives the same log.
        """
        import pandas as pd

        episodes = {"episode": self.episode} if np.any(self.episode != 0) else {}
        table = pd.DataFrame({**episodes, **self.channels, **self.unknown}, index=pd.Index(self.time, name=CLOCK))
        table.attrs[ATTRIBUTE] = meta_to_json(self.meta)
        return table

    def __repr__(self) -> str:
        joints = len({name.partition(".")[2] for name in self.channels})
        kinds = ", ".join(dict.fromkeys(name.partition(".")[0] for name in self.channels))
        return f"<Log of {self.meta.robot or 'a robot'}: {self._facts['samples']}; {kinds} ({joints} names)>"

    def _repr_html_(self) -> str:
        from sysid_btr.display.html import facts_html

        return facts_html("log", self._facts)

    @property
    def _facts(self) -> dict[str, str]:
        """What was recorded, for how long, and which joints moved."""
        facts = {
            "robot": self.meta.robot or "not said",
            "samples": f"{len(self)} samples in {len(self.episodes())} episode(s), {self._seconds:.1f} s",
            "sampled every": si(float(np.median(np.diff(self.time))), "s") if len(self) > 1 else "-",
            "base": self.meta.mount,
        }
        for kind in dict.fromkeys(name.partition(".")[0] for name in self.channels):
            facts[kind] = ", ".join(self.joints(kind))
        return facts

    @property
    def recorded(self) -> str | None:
        """When it began, ISO 8601: as the metadata say, or of a clock that counts from 1970; None if neither."""
        if self.meta.recorded:
            return self.meta.recorded
        if len(self) and SINCE_1970[0] < self.time[0] < SINCE_1970[1]:
            return datetime.fromtimestamp(float(self.time[0]), UTC).isoformat(timespec="seconds")
        return None

    @property
    def _seconds(self) -> float:
        return float(np.ptp(self.time)) if len(self) else 0.0

    @property
    def is_motion(self) -> bool:
        """Whether this is a motion to be played, by its own account and by what it holds: commands alone."""
        return self.meta.source == MOTION and all(column.partition(".")[0] in COMMANDS for column in self.channels)

    def joints(self, channel: str) -> tuple[str, ...]:
        """Names that have a column in `channel`, in column order."""
        prefix = f"{channel}."
        return tuple(column.removeprefix(prefix) for column in self.channels if column.startswith(prefix))

    def has(self, channel: str, name: str) -> bool:
        """Whether the column ``<channel>.<name>`` exists."""
        return f"{channel}.{name}" in self.channels

    def array(self, channel: str, names: Sequence[str]) -> FloatArray:
        """Columns of one channel as a matrix.

        Parameters
        ----------
        channel : str
            A channel of the schema, e.g. ``"position"``.
        names : sequence of str
            Joints (or IMU axes, or force sites), in the order wanted.

        Returns
        -------
        ndarray, shape (n, len(names))
            A new array; NaN where a value is missing.

        Raises
        ------
        LogError
            If a column does not exist; the message lists what there is.
        """
        there = self.joints(channel)
        missing = [name for name in names if name not in there]
        if missing:
            where = f" ({self.path})" if self.path else ""
            raise LogError(
                f"the log{where} has no {channel} for {', '.join(with_hint(name, there) for name in missing)}; "
                f"its {channel} columns: {', '.join(there) or 'none'}"
            )
        if not names:
            return np.empty((len(self), 0))
        return np.stack([self.channels[f"{channel}.{name}"] for name in names], axis=1).astype(np.float64)

    def window(self, start: int, stop: int) -> Log:
        """Samples `start` to `stop` (exclusive, as in a slice), as views of the same arrays."""
        rows = slice(start, stop)
        return replace(
            self,
            time=self.time[rows],
            channels={name: values[rows] for name, values in self.channels.items()},
            episode=self.episode[rows],
            unknown={name: values[rows] for name, values in self.unknown.items()},
        )

    def once(self, key: tuple[Any, ...], work: Callable[[], T]) -> T:
        """What `work` finds of this log, which never changes; found once for each key and kept as long as the log."""
        if key not in self._found:
            self._found[key] = work()
        found: T = self._found[key]
        return found

    @cached_property
    def _found(self) -> dict[tuple[Any, ...], Any]:
        return {}

    def __getstate__(self) -> dict[str, Any]:
        """The log itself, without what was found of it."""
        return {name: value for name, value in vars(self).items() if name != "_found"}

    @property
    def content(self) -> str:
        """Digest of what was recorded, wherever it is kept and whenever its clock began."""
        from hashlib import sha256

        digest = sha256(np.round(self.time - self.time[:1], 9).tobytes())
        for name in sorted(self.channels):
            digest.update(name.encode() + self.channels[name].tobytes())
        return digest.hexdigest()

    def episodes(self) -> tuple[slice, ...]:
        """Row ranges of the episodes: the runs of equal episode number, in row order."""
        if len(self) == 0:
            return ()
        borders = np.flatnonzero(np.diff(self.episode)) + 1
        edges = [0, *borders.tolist(), len(self)]
        return tuple(slice(start, stop) for start, stop in itertools.pairwise(edges))


META_KEYS = tuple(f.name for f in fields(LogMeta) if f.name != "extra")
"""Metadata keys of the schema."""


ALWAYS_WRITTEN = ("schema", "robot", "mount", "source")
"""Of them, those that a file states in any case."""


def meta_to_json(meta: LogMeta) -> dict[str, Any]:
    """Metadata as the JSON object of the schema; what is at its default is left out, unknown keys are kept."""
    default = LogMeta()
    known = {
        f.name: getattr(meta, f.name)
        for f in fields(LogMeta)
        if f.name != "extra" and (f.name in ALWAYS_WRITTEN or getattr(meta, f.name) != getattr(default, f.name))
    }
    for name, value in known.items():
        if isinstance(value, Mapping):
            known[name] = dict(value)
    return {**known, **{key: value for key, value in meta.extra.items() if key not in known}}


def meta_of_json(known: Mapping[str, Any]) -> LogMeta:
    """Metadata of what `meta_to_json` gave."""
    extra = {key: value for key, value in known.items() if key not in META_KEYS}
    return LogMeta(**{key: value for key, value in known.items() if key in META_KEYS}, extra=extra)


def torques_of_currents(channels: Mapping[str, FloatArray], meta: LogMeta) -> dict[str, FloatArray]:
    """`effort` of joints that have a current and, in the metadata, a torque constant, but no effort of their own."""
    constant = meta.torque_constant
    found = {}
    for name, values in channels.items():
        channel, _, joint = name.partition(".")
        known = constant.get(joint) if isinstance(constant, Mapping) else constant
        if channel == "current" and known is not None and f"effort.{joint}" not in channels:
            found[f"effort.{joint}"] = known * values
    return found


def is_schema_column(name: str) -> bool:
    """Whether a column name (other than ``time`` and ``episode``) is of the schema."""
    channel, dot, rest = name.partition(".")
    if not (dot and rest):
        return False
    return rest in IMU_NAMES if channel == "imu" else channel in CHANNELS


def closest(name: str, known: Iterable[str], cutoff: float = 0.75) -> str | None:
    """The known name most like `name`, or None; a difference in letter case alone always matches."""
    by_folded = {other.casefold(): other for other in known}
    folded = name.casefold()
    if folded in by_folded:
        return by_folded[folded]
    match = difflib.get_close_matches(folded, by_folded, n=1, cutoff=cutoff)
    return by_folded[match[0]] if match else None


def with_hint(name: str, known: Iterable[str]) -> str:
    """`name`, followed by the known name it may have meant."""
    guess = closest(name, known)
    return f"{name} (did you mean {guess}?)" if guess else name
