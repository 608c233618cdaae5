"""A small, whole example of every format that is read, and the command that reads it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sysid_btr.cli import run
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log, write_log

SAMPLES = Path(__file__).resolve().parents[2] / "sample_logs"
JOINT, ROWS = "pendulum", 150
MODEL, LOG, TABLE = "pendulum.xml", "log.parquet", "table.csv"
FIT = ("fit", "-m", MODEL, "-l", LOG, "-f", "mass:*", "-o", "run")
SERVO = ("--servo", "kp=5,kv=0.2")
ORIGIN = 1_700_000_000_000_000_000
"""ns, of stamps."""
URDF = """<?xml version="1.0"?>
<robot name="arm"><link name="base"/>
  <link name="upper"><visual><geometry><mesh filename="package://arm/upper.stl"/></geometry></visual>
    <inertial><origin xyz="0 0 -0.1"/><mass value="1.5"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="pendulum" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="5" velocity="5"/><dynamics damping="0.1" friction="0.02"/></joint>
</robot>
"""
MAPPING = """[time]
column = "t"
[units]
time = "ms"
position = "deg"
[channels]
command = "{joint}_goal"
position = ["{joint}_angle"]
[joints.pendulum]
sign = -1
offset = 0.02
[meta]
robot = "pendulum"
servo_period = 0.01
"""
STUDY = """model = "pendulum.xml"
log = ["log.parquet"]
fit = ["mass:*", "kp:*=shared"]
holdout = 0.3
seed = 1
[bounds]
"kp" = [0.5, 2.0]
[noise]
"position" = 1e-4
"""


@dataclass(frozen=True)
class Example:
    """A whole set of files, one of which is about to be broken.

    Attributes
    ----------
    name : of the format.
    files : path -> content; of those that may be broken. Without any it is the command that is broken.
    command : that reads them, in their folder.
    beside : path -> content of what else the command reads.
    """

    name: str
    files: Mapping[str, bytes]
    command: tuple[str, ...]
    beside: Mapping[str, bytes]


def make_examples() -> tuple[Example, ...]:
    """Every example; bags and MCAP files only where their libraries are installed."""
    log = read_log(SAMPLES / "pendulum_clean.parquet").window(0, ROWS)
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_log(log, folder / LOG)
        (folder / MODEL).write_bytes((SAMPLES / MODEL).read_bytes())
        known = {file: (folder / file).read_bytes() for file in (LOG, MODEL)}
        fitted = _fitted(folder)
    journal = {name: content for name, content in fitted.items() if "journal" in name}
    table = {TABLE: _csv(log, "t", "{}_goal", "{}_angle")}
    found = [
        Example("log", {LOG: known[LOG]}, ("validate", LOG, "-m", MODEL), known),
        Example("log, replayed", {LOG: known[LOG]}, ("replay", "-m", MODEL, "-l", LOG), known),
        Example("csv", {TABLE: _csv(log, "time", "command.{}", "position.{}")}, ("import", TABLE), {}),
        Example("parquet", {"table.parquet": _parquet(log)}, ("import", "table.parquet"), {}),
        Example("naoqi", {TABLE: _naoqi(log)}, ("import", TABLE), {}),
        Example("lerobot", _lerobot(log), ("import", "set"), {}),
        Example("mjcf", {MODEL: known[MODEL]}, ("validate", LOG, "-m", MODEL), known),
        Example("urdf", {"arm.urdf": URDF.encode()}, ("validate", LOG, "-m", "arm.urdf", *SERVO), known),
        Example("study", {"study.toml": STUDY.encode()}, ("validate", LOG, "--config", "study.toml"), known),
        Example("mapping", {"map.toml": MAPPING.encode()}, ("import", TABLE, "--map", "map.toml"), table),
        Example("params", {"params.json": fitted["run/params.json"]}, _with_params(), known),
        Example("result", {"run/result.json": fitted["run/result.json"]}, ("report", "run"), {}),
        Example("options", {}, ("validate", LOG), known),
        Example("journal", journal, (*FIT, "--resume"), known),
    ]
    if find_spec("rosbags") is not None:
        found.append(Example("ros2", _bag(log), ("import", "bag"), {}))
    if find_spec("mcap") is not None:
        found.append(Example("mcap", {"log.mcap": _mcap(log)}, ("import", "log.mcap"), {}))
    return tuple(found)


def _with_params() -> tuple[str, ...]:
    return ("replay", "-m", MODEL, "-l", LOG, "--params", "params.json")


def _fitted(folder: Path) -> dict[str, bytes]:
    """What a fit of the log writes."""
    with chdir(folder), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        code = run(FIT)
    if code not in (0, 5):
        raise RuntimeError(f"the example cannot be fitted: exit {code}")
    written = [file for file in (folder / "run").iterdir() if file.suffix in (".json", ".jsonl", ".npy")]
    return {f"run/{file.name}": file.read_bytes() for file in written}


def _columns(log: Log) -> dict[str, Any]:
    return {kind: log.channels[f"{kind}.{JOINT}"] for kind in ("command", "position")}


def _csv(log: Log, time: str, command: str, position: str) -> bytes:
    columns = _columns(log)
    lines = [",".join((time, command.format(JOINT), position.format(JOINT)))]
    rows = zip(log.time, columns["command"], columns["position"], strict=True)
    return "\n".join([*lines, *(f"{t:.4f},{c:.6f},{p:.6f}" for t, c, p in rows), ""]).encode()


def _naoqi(log: Log) -> bytes:
    columns, key = _columns(log), "Device/SubDeviceList/HeadYaw"
    lines = [f"DCM/Time,{key}/Position/Actuator/Value,{key}/Position/Sensor/Value,{key}/Hardness/Actuator/Value"]
    rows = zip(log.time, columns["command"], columns["position"], strict=True)
    return "\n".join([*lines, *(f"{1000 * t:.0f},{c:.6f},{p:.6f},0.9" for t, c, p in rows), ""]).encode()


def _saved(write: Callable[[Path], None]) -> dict[str, bytes]:
    """All files that something writes into a folder."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        write(folder)
        return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def _parquet(log: Log) -> bytes:
    table = pa.table({"t": log.time, **{f"{JOINT}_{kind}": values for kind, values in _columns(log).items()}})
    return _saved(lambda folder: pq.write_table(table, folder / "table"))["table"]


def _lerobot(log: Log) -> dict[str, bytes]:
    columns, n = _columns(log), len(log)
    lists = {
        feature: pa.array([[float(v)] for v in columns[kind]], type=pa.list_(pa.float32(), 1))
        for feature, kind in (("action", "command"), ("observation.state", "position"))
    }
    frames = {**lists, "frame_index": np.arange(n), "episode_index": np.zeros(n, dtype=np.int64)}
    frames["timestamp"] = (np.arange(n) / 100).astype(np.float32)
    features = {f: {"dtype": "float32", "shape": [1], "names": [f"{JOINT}.pos"]} for f in lists}
    info = {"codebase_version": "v3.0", "fps": 100, "robot_type": JOINT, "features": features}

    def write(folder: Path) -> None:
        (folder / "set" / "data").mkdir(parents=True)
        (folder / "set" / "meta").mkdir()
        pq.write_table(pa.table(frames), folder / "set" / "data" / "file-000.parquet")
        (folder / "set" / "meta" / "info.json").write_text(json.dumps(info, indent=1))

    return _saved(write)


def _mcap(log: Log) -> bytes:
    from mcap.writer import Writer

    def write(folder: Path) -> None:
        with (folder / "log").open("wb") as file:
            writer = Writer(file)
            writer.start()
            schema = writer.register_schema("sensor_msgs/msg/JointState", "jsonschema", b"{}")
            topics = {k: writer.register_channel(f"/joint_{k}s", "json", schema) for k in _columns(log)}
            for i, t in enumerate(log.time):
                stamp = ORIGIN + round(1e9 * t)
                header = {"stamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9}}
                for kind, values in _columns(log).items():
                    message = {"header": header, "name": [JOINT], "position": [float(values[i])]}
                    writer.add_message(topics[kind], stamp, json.dumps(message).encode(), stamp)
            writer.finish()

    return _saved(write)["log"]


def _bag(log: Log) -> dict[str, bytes]:
    from rosbags import rosbag2
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS2_JAZZY), "sensor_msgs/msg/JointState"
    types, none = store.types, np.zeros(0)

    def write(folder: Path) -> None:
        with rosbag2.Writer(folder / "bag", version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
            topics = {k: writer.add_connection(f"/joint_{k}s", kind, typestore=store) for k in _columns(log)}
            for i, t in enumerate(log.time):
                stamp = ORIGIN + round(1e9 * t)
                time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
                header = types["std_msgs/msg/Header"](stamp=time, frame_id="")
                for name, values in _columns(log).items():
                    message = types[kind](header, [JOINT], values[i : i + 1].copy(), none, none)
                    writer.write(topics[name], stamp, store.serialize_cdr(message, kind))

    return _saved(write)
