"""Options are declared once: flags, study file, fingerprint and the call from Python hold the same."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import typer
from terminal import Cli

from sysid_btr.cli import app
from sysid_btr.cli.commands import STUDIED, VERBS, options_class, study_options
from sysid_btr.cli.demo import sample_logs
from sysid_btr.cli.excite import ExciteOptions
from sysid_btr.cli.fit import FitOptions, fit
from sysid_btr.cli.fitting import fingerprint
from sysid_btr.cli.kinds import KINDS, Holdout, Kind, Names, Numbers, Ranges, Texts
from sysid_btr.cli.options import option, options_of
from sysid_btr.cli.study_file import read_study_file, toml
from sysid_btr.errors import UsageError
from sysid_btr.models.builtin import load_robot
from sysid_btr.result import read_result

Verb = Callable[[Any], int]
SAMPLES = sample_logs()
MODEL, LOG = str(SAMPLES / "pendulum.xml"), SAMPLES / "pendulum_clean.parquet"
WITH_A_JOURNAL = ("fit", "posterior", "close", "btr", "excite")
DECIDES_NOTHING = {
    "executor",
    "exchange",
    "explain",
    "iterations",
    "json",
    "max_evaluations",
    "out",
    "overwrite",
    "profile",
    "render",
    "requirement",
    "resume",
    "threads",
    "wait",
    "worthwhile",
}
"""How long is searched, where, and what is made of the answer: a journal goes on under other ones."""
EXAMPLES: dict[Any, tuple[Any, Any]] = {
    str: ("a", '"a"'),
    str | None: ("a", '"a"'),
    int: (7, "7"),
    int | None: (7, "7"),
    float: (0.5, "0.5"),
    float | None: (2.0, "2"),
    bool: (True, "true"),
    Path: (Path("a"), '"a"'),
    Path | None: (Path("a"), '"a"'),
    tuple[str, ...]: (("a,b", "c"), '["a,b", "c"]'),
    tuple[Path, ...]: ((Path("a"), Path("b")), '["a", "b"]'),
    Names: (("a", "b", "c"), '["a,b", "c"]'),
    Numbers: ({"kp:*": 1.0, "kp:b": 0.1}, '{"kp:*" = 1, "kp:b" = 0.1}'),
    Ranges: ({"kp": (0.5, 2.0)}, "{kp = [0.5, 2]}"),
    Texts: ({"kp": "normal(1, 0.1)"}, '{kp = "normal(1, 0.1)"}'),
    Holdout: (0.25, "0.25"),
}
"""A value of each type, and how a study file says it."""


def named(name: str) -> Verb:
    [verb] = [v for v in VERBS if v.__name__.rstrip("_") == name]
    return verb


def every_option() -> list[tuple[str, str]]:
    return [(verb.__name__.rstrip("_"), name) for verb in VERBS for name in options_of(options_class(verb))]


def kind_of(kind: Kind) -> Any:
    return next(typed for typed, known in KINDS.items() if known is kind)


@pytest.mark.parametrize("verb", VERBS, ids=lambda v: v.__name__)
def test_the_command_line_has_every_option_and_no_other(verb: Verb) -> None:
    parameters = typer.main.get_command(app).commands[verb.__name__.rstrip("_")].params
    flags = {p.name: p.opts for p in parameters}
    known = options_of(options_class(verb))
    assert [p.name for p in parameters][: len(known)] == list(known)
    assert set(flags) - set(known) == {"debug"} | ({"config"} if verb in STUDIED else set())
    assert set(known) == {f.name for f in fields(options_class(verb))}
    for name, one in known.items():
        assert one.positional or one.flag in flags[name]
        assert one.help.endswith((".", ")"))
        assert one.help[0].isupper() or one.help.startswith("params.json")


@pytest.mark.parametrize("typed", KINDS, ids=str)
def test_a_value_is_the_same_from_a_flag_a_study_file_and_python(typed: Any) -> None:
    value, text = EXAMPLES[typed]
    kind = KINDS[typed]
    written = tomllib.loads(f"a = {text}")["a"]
    assert kind.wrong(written) == []
    for given in (kind.given(written), kind.given(value)):
        typed_in: Any = [Path(g) for g in given] if kind.typed == list[Path] else given
        assert kind.value("--a", Path(given) if kind.typed is Path else typed_in) == value
    assert kind.wrong(None)


def test_a_study_file_holds_every_flag_of_every_verb_that_takes_one() -> None:
    for verb in STUDIED:
        for name, one in options_of(options_class(verb)).items():
            assert one.positional or study_options()[name].kind == one.kind, name


def test_a_study_file_is_read_as_its_options_say(tmp_path: Path) -> None:
    known = study_options()
    lines = [f"{name.replace('_', '-')} = {EXAMPLES[kind_of(one.kind)][1]}" for name, one in known.items()]
    (tmp_path / "study.toml").write_text("\n".join(lines))
    (tmp_path / "a").touch()
    given = read_study_file(tmp_path / "study.toml", known)
    assert set(given) == set(known)
    assert given["log"] == [str(tmp_path / "a"), "b"]
    assert given["model"] == str(tmp_path / "a")
    assert given["out"] == "a"  # written, not read
    assert given["start"] == ["kp:*=1.0", "kp:b=0.1"]


def test_text_of_a_study_file_is_read_as_it_was_written() -> None:
    for text in ('a"b\\c', "tab\tnew\nline", "del\x7f", "Gelenk äß 日本"):
        assert tomllib.loads(f"a = {toml([text])}")["a"] == [text]


@pytest.mark.parametrize(("verb", "name"), [(v, n) for v, n in every_option() if v in WITH_A_JOURNAL])
def test_the_fingerprint_covers_all_that_decides_which_candidates_are_evaluated(verb: str, name: str) -> None:
    kind = options_class(named(verb))
    one = options_of(kind)[name]
    robot = load_robot(MODEL)
    plain = kind(model=MODEL)  # type: ignore[call-arg]
    value = not one.default if isinstance(one.default, bool) else EXAMPLES[kind_of(one.kind)][0]
    other = replace(plain, **{name: value})
    assert getattr(other, name) != getattr(plain, name)
    if name == "model":  # it is known by its content
        robot = replace(robot, make_spec=load_robot("emps").make_spec)
    same = fingerprint(verb, other, robot) == fingerprint(verb, plain, load_robot(MODEL))  # type: ignore[arg-type]
    assert same == (name in DECIDES_NOTHING)
    assert one.decides == (name not in DECIDES_NOTHING)


def test_files_are_known_by_what_they_hold(tmp_path: Path) -> None:
    robot = load_robot(MODEL)

    def digest(**asked: Any) -> str:
        return fingerprint("fit", FitOptions(**asked), robot)

    (tmp_path / "log").write_bytes(b"1")
    (tmp_path / "same").write_bytes(b"1")
    (tmp_path / "params.json").write_text("{}")
    first = digest(log=(tmp_path / "log",), params=tmp_path)
    assert digest(log=(tmp_path / "same",), params=tmp_path / "params.json") == first
    assert digest(log=(tmp_path / "same",), params=tmp_path, holdout=(tmp_path / "log",)) != first
    (tmp_path / "log").write_bytes(b"2")
    assert digest(log=(tmp_path / "log",), params=tmp_path) != first
    assert digest(start={"a*": 1.0, "*b": 2.0}) != digest(start={"*b": 2.0, "a*": 1.0})


def test_a_new_option_has_to_say_whether_it_decides() -> None:
    with pytest.raises(TypeError, match="decides"):
        option(1, "A new one.")  # type: ignore[call-arg]


def test_limits_hold_from_python_too() -> None:
    with pytest.raises(UsageError, match="--seed -1: give at least 0"):
        FitOptions(seed=-1)
    with pytest.raises(UsageError, match="--max-evaluations 0: give at least 1"):
        ExciteOptions(max_evaluations=0)


def test_a_verb_is_a_function_of_its_options(cli: Cli, tmp_path: Path) -> None:
    asked = FitOptions(model=MODEL, log=(LOG,), fit=("mass:arm",), bounds={"mass": (0.5, 2.0)}, holdout=0.2, threads=1)
    assert fit(replace(asked, out=tmp_path / "python")) == 0
    flags = ("--fit", "mass:arm", "--bounds", "mass=0.5:2", "--holdout", "0.2", "--threads", "1")
    assert cli("fit", "--model", MODEL, "--log", LOG, *flags, "--out", tmp_path / "shell").code == 0
    results = [read_result(tmp_path / name) for name in ("python", "shell")]
    assert results[0]["parameters"] == results[1]["parameters"]
    assert results[0]["parameters"][0]["bounds"] == [0.5, 2.0]
