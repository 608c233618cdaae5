"""Whatever a file or a command line holds: an exit code with a meaning, no traceback, no gigabytes.

The cases of `benchmarks.fuzz`, of which `python -m benchmarks.fuzz` runs more, and texts that hypothesis thinks of.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.fuzz.cases import Ending, ending, run_case
from benchmarks.fuzz.examples import LOG, MODEL, SAMPLES, Example, make_examples
from benchmarks.fuzz.truth import SPOILT, answer, fitted, recorded
from sysid_btr.io._file import parse_meta
from sysid_btr.io.problem import Problem
from sysid_btr.models.builtin import load_robot

COSTLY = {"journal": 12}
"""Cases of formats whose reading is followed by work."""
CASES = 136
"""Of any other; 14 formats and the command line."""
PARTS = 4
"""Tests that a format's cases are divided into, for as many workers."""

JSON: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=10), inner, max_size=3),
    max_leaves=6,
)
KEYS = ("schema", "robot", "mount", "sample_period", "servo_period", "units", "noise", "at", "torque_constant", "drive")


def quick(cases: int) -> settings:
    """So many cases, the same each time, however long they take."""
    return settings(
        max_examples=cases, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )


FLAGS = ("--fit", "--bounds", "--start", "--holdout", "--noise", "--shift", "--at", "--servo", "--nuisance")


@cache
def examples() -> dict[str, Example]:
    return {example.name: example for example in make_examples()}


NAMES = ("log", "log, replayed", "csv", "parquet", "naoqi", "lerobot", "mjcf", "urdf", "study", "mapping", "params")
MORE = ("result", "options", "journal", "ros2", "mcap")


def in_a_folder(example: Example, command: tuple[str, ...]) -> Ending:
    from contextlib import chdir

    with TemporaryDirectory() as folder:
        for path, content in {**example.beside, **example.files}.items():
            Path(folder, path).parent.mkdir(parents=True, exist_ok=True)
            Path(folder, path).write_bytes(content)
        with chdir(folder):
            return ending(command)


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("name", [*NAMES, *MORE])
def test_no_broken_file_is_a_defect_of_this_program(name: str, part: int) -> None:
    if name not in examples():
        pytest.skip("its library is not installed")
    count = COSTLY.get(name, CASES) // PARTS
    wrong = {n: e for n in range(part * count, (part + 1) * count) if (e := run_case(examples()[name], n)).wrong}
    assert not wrong


FOUND = (8752, 10394, 13946, 13981, 18701, 21101, 21658, 22293, 25492, 33741, 51974, 57069, 77549, 99475)


@pytest.mark.parametrize("case", FOUND)
def test_what_the_fuzzer_once_found_is_refused(case: int) -> None:
    """Its numbers in benchmarks.fuzz: defects until they were mended; what a number means follows the examples."""
    order = list(examples())
    if set(order) != {*NAMES, *MORE}:
        pytest.skip("the library of a format is not installed")
    assert not run_case(examples()[order[case % len(order)]], case // len(order)).wrong


@pytest.mark.parametrize("name", [*NAMES, *MORE])
def test_every_example_is_read_while_it_is_whole(name: str) -> None:
    if name not in examples():
        pytest.skip("its library is not installed")
    assert in_a_folder(examples()[name], examples()[name].command) == Ending(0, "")


@quick(150)
@given(st.dictionaries(st.sampled_from(KEYS) | st.text(max_size=8), JSON))
def test_any_metadata_become_metadata_and_problems(raw: dict[str, Any]) -> None:
    problems: list[Problem] = []
    meta = parse_meta(raw, problems)
    assert meta.mount in ("fixed", "free")
    assert all(p.severity in ("error", "warning") for p in problems)


@quick(40)
@given(
    st.sampled_from(
        ("--fit", "--bounds", "--start", "--holdout", "--noise", "--shift", "--at", "--servo", "--nuisance")
    ),
    st.text(max_size=12) | st.from_regex(r"(mass|kp|x):[a-z*?\[]{0,5}(=[a-z0-9.:]{0,6})?", fullmatch=True),
)
def test_any_text_of_an_option_is_used_or_refused(flag: str, text: str) -> None:
    command = ("fit", "-m", MODEL, "-l", LOG, "--max-evaluations", "1", flag, text)
    assert not in_a_folder(examples()["log"], command).wrong


@quick(20)
@given(JSON)
def test_any_json_is_a_result_or_refused(content: Any) -> None:
    result = json.loads(examples()["result"].files["run/result.json"])
    for key in ("parameters", "nominal", "model", "numerics", "misfit"):
        files = {"run/result.json": json.dumps({**result, key: content}).encode()}
        assert not in_a_folder(Example("result", files, (), {}), ("report", "run")).wrong


@pytest.mark.parametrize("kind", ["nothing", "ten times the noise", "30 % missing", "30 ms late", "a scale of 1.1"])
def test_no_answer_is_sure_and_wrong(kind: str) -> None:
    robot = load_robot(str(SAMPLES / MODEL))
    log = SPOILT[kind](recorded(robot, 3), np.random.default_rng(3))
    assert "WRONG" not in answer(robot, log, fitted)


def test_the_examples_are_the_samples() -> None:
    assert examples()["mjcf"].files[MODEL] == (SAMPLES / MODEL).read_bytes()
