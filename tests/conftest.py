"""Fixtures shared by the tests."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from terminal import Answer, Cli

from sysid_btr.cli import run
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.result import result_schema
from sysid_btr.run_folder import RESULT, Folder

GOOD_JOINTS = ("HeadYaw", "LKneePitch", "RKneePitch", "LHipRoll", "RHipRoll")


@pytest.fixture(scope="session", autouse=True)
def results_follow_their_schema() -> Iterator[None]:
    """Every result.json that a test has written is what its schema says."""
    validator = jsonschema.Draft202012Validator(result_schema())
    write = Folder.write

    def checked(self: Folder, name: str, content: str | bytes) -> Path:
        if name == RESULT:
            validator.validate(json.loads(content))
        return write(self, name, content)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Folder, "write", checked)
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the recorded logs; tests that need it skip where it is missing."""
    named = os.environ.get("SYSID_BTR_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"recorded logs not found in {folder}; set SYSID_BTR_DATA to their folder")
    return folder


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Cli:
    """Run a command line in this process; no traceback may reach the user."""

    def call(*argv: object) -> Answer:
        capsys.readouterr()
        code = run([str(a) for a in argv])
        text = capsys.readouterr()
        assert "Traceback" not in text.err
        return Answer(code, text.out, text.err)

    return call


def make_good_log(seed: int = 0, n: int = 800, period: float = 0.01) -> Log:
    """A small log with nothing wrong: five joints that follow smooth commands 40 ms late, and an IMU."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) * period
    late = time - 0.04
    channels = {}
    for i, joint in enumerate(GOOD_JOINTS):
        frequency, phase = 0.35 + 0.13 * i, 1.1 * i
        command = 0.3 * np.sin(2 * np.pi * frequency * time + phase) + 0.1 * np.sin(2.7 * time + i * i)
        response = 0.3 * np.sin(2 * np.pi * frequency * late + phase) + 0.1 * np.sin(2.7 * late + i * i)
        tick = 2 * np.pi / 4096
        position = np.round((response + rng.normal(scale=0.001, size=n)) / tick) * tick
        channels[f"command.{joint}"] = command
        channels[f"position.{joint}"] = position
    for joint in GOOD_JOINTS:
        channels[f"velocity.{joint}"] = np.gradient(channels[f"position.{joint}"], period)
        channels[f"temperature.{joint}"] = np.full(n, 38.0)
    tilt = 0.2 * np.sin(2.0 * time)
    channels["imu.angle_x"] = tilt + rng.normal(scale=1e-3, size=n)
    channels["imu.gyro_x"] = 0.4 * np.cos(2.0 * time) + rng.normal(scale=5e-3, size=n)
    for axis, value in zip("xyz", (0.0, 0.0, 9.81), strict=True):
        channels[f"imu.acc_{axis}"] = value + rng.normal(scale=0.05, size=n)
    channels["force.LFoot"] = np.maximum(0.0, 25 * np.sin(4 * time)) + np.abs(rng.normal(scale=0.1, size=n))
    meta = LogMeta(robot="toy", mount="free", sample_period=period, source="synthetic", extra={"operator": "me"})
    return Log(time=time, channels=channels, meta=meta, episode=np.zeros(n, dtype=np.int64))


@pytest.fixture
def good_log() -> Log:
    """A log in which validation finds nothing."""
    return make_good_log()
