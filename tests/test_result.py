"""result.json: strict JSON, every promised key, and the same numbers when read back."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_btr.diagnosis.closing import Candidate, Closing, NamedEffect, StepRecord
from sysid_btr.display.text import console, show
from sysid_btr.errors import UsageError
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.scores import ChannelScore, Scores
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.builtin import load_robot
from sysid_btr.report.html import Picture, render
from sysid_btr.result import clean, exit_code, read_result, result_schema, to_json
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.model import Model
from sysid_btr.units import si, si_all, with_digits_of

PROMISED = {
    "schema",
    "kind",
    "verdict",
    "noise_floor",
    "nominal",
    "before",
    "after",
    "parameters",
    "effects",
    "candidates",
    "steps",
    "signature",
    "seed",
    "versions",
    "replays",
    "wall_s",
    "logs",
    "model",
}
ARM = """
<mujoco>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><position name="hinge" joint="hinge" kp="8" kv="0.4"/></actuator>
</mujoco>
"""


@pytest.fixture
def study(tmp_path: Path) -> Study:
    (tmp_path / "arm.xml").write_text(ARM)
    time = np.arange(200) * 0.01
    motion = 0.3 * np.sin(3 * time)
    channels = {"command.hinge": motion, "position.hinge": motion}
    log = Log(time, channels, LogMeta(), np.zeros(200, dtype=np.int64))
    robot = load_robot(str(tmp_path / "arm.xml"))
    return make_study(robot, [log], numerics=Numerics("RK4", 0.005), threads=1)


def estimate(name: str, identifiable: str = "yes", reason: str = "") -> Estimate:
    return Estimate(
        name=name,
        unit="Nm",
        nominal=0.0,
        value=0.3,
        std=0.01,
        ci95=(0.28, 0.32),
        bounds=(0.0, math.inf),
        identifiable=identifiable,  # type: ignore[arg-type]
        at_bound=False,
        reason=reason,
    )


def scores(rmse: float) -> Scores:
    channel = ChannelScore(rmse, rmse / 0.2, np.float64((rmse / 6e-4) ** 2), {"hinge": rmse}, 6e-4)
    return Scores({"position": channel}, {"position": channel})


LEFT = {
    "joint": "<hinge>",
    "share": np.float64(0.97),
    "torque_rms": 0.41,
    "torque_noise": 0.115,
    "unit": "Nm",
    "periodic": None,
    "dependence": [{"on": "position_and_direction", "share": 0.94}, {"on": "position:knee", "share": 0.002}],
}
"""Of what is left, as `diagnosis.signature` has it of a joint."""


def closing(study: Study, **changes: object) -> Closing:
    effect = NamedEffect(
        effect="coulomb_friction",
        family="friction",
        variant="",
        where=("hinge",),
        parameters=(estimate("coulomb_friction:hinge"),),
        certainty=0.93,
        otherwise={"spring": 0.05},
        explains={"train": 0.98, "holdout": 0.97},
        provisional=True,
        gain_holdout=0.97,
        confused_with=("stribeck_friction",),
        sentence="dry friction at <hinge>",
        evidence={"family": 0.9, "place": 1.0, "left": 0.2},
    )
    content: dict[str, object] = {
        "study": study,
        "verdict": "explained",
        "message": "dry friction",
        "noise_floor": {"position": 6e-4},
        "nominal": scores(0.01),
        "before": scores(0.004),
        "after": scores(6.1e-4),
        "parameters": (estimate("mass:arm", "no", "hardly any sensor responds"),),
        "effects": (effect,),
        "candidates": (Candidate("coulomb_friction", ("hinge",), 0.9, math.nan, ()),),
        "steps": (StepRecord((), (), 44.0, 45.0), StepRecord(("coulomb_friction at hinge",), (), 1.0, 1.1)),
        "signature": {"summary": "a torque at hinge, a function of the velocity", "joints": [LEFT]},
        "before_model": Model.of(()),
        "model": Model.of(()),
        "replays": 12,
        "seconds": 1.5,
    }
    return Closing(**{**content, **changes})  # type: ignore[arg-type]


def test_every_promised_key_is_there(study: Study) -> None:
    result = closing(study).to_dict(seed=4)
    assert set(result) >= PROMISED
    for stage in ("nominal", "before", "after"):
        for part in ("train", "holdout"):
            assert set(result[stage][part]["position"]) >= {"rmse", "nrmse", "chi2"}
    [parameter] = result["parameters"]
    assert {"name", "unit", "nominal", "value", "std", "ci95", "bounds"} <= set(parameter)
    assert {"identifiable", "at_bound", "reason"} <= set(parameter)
    [effect] = result["effects"]
    assert {"effect", "family", "where", "parameters", "certainty", "otherwise", "explains"} <= set(effect)
    assert {"provisional", "gain_holdout", "evidence"} <= set(effect)
    assert set(effect["parameters"][0]) == set(parameter)


def test_a_result_is_what_its_schema_says_and_nothing_else(study: Study) -> None:
    schema = result_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    result = closing(study).to_dict(seed=4)
    jsonschema.validate(result, schema)
    for wrong in ({**result, "chi2": 1.0}, {**result, "verdict": "perhaps"}, {**result, "covariance": None}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, schema)


def undescribed(entry: Any, name: str = "") -> Iterator[str]:
    """Names within an entry of a schema that nothing describes."""
    for inner, value in entry.get("properties", {}).items():
        if not {"description", "$ref"} & set(value):
            yield f"{name}.{inner}"
        yield from undescribed(value, f"{name}.{inner}")
    parts = [entry.get("items"), entry.get("additionalProperties"), *entry.get("anyOf", ())]
    for part in parts:
        if isinstance(part, dict):
            yield from undescribed(part, name)


def test_every_name_of_a_result_says_what_it_is() -> None:
    schema = result_schema()
    assert list(undescribed(schema)) == []
    assert [name for key, entry in schema["$defs"].items() for name in undescribed(entry, key)] == []


def test_round_trip(study: Study, tmp_path: Path) -> None:
    result = closing(study).to_dict(seed=4, wall_s=2.5)
    file = tmp_path / "result.json"
    file.write_text(to_json(result))
    assert read_result(file) == result
    assert read_result(tmp_path) == result


def test_what_is_not_finite_is_null(study: Study) -> None:
    text = to_json(closing(study).to_dict())
    result = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} in result.json"))
    assert result["parameters"][0]["bounds"] == [0.0, None]
    assert result["candidates"][0]["amplitude"] is None


NESTED = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(NESTED)
def test_clean_gives_strict_json_and_is_idempotent(value: object) -> None:
    once = clean(value)
    assert json.loads(json.dumps(once, allow_nan=False)) == once
    assert clean(once) == once


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False)))
def test_finite_numbers_survive_bit_for_bit(values: list[float]) -> None:
    assert json.loads(to_json({"x": np.array(values)}))["x"] == values


@pytest.mark.parametrize(
    "text", ["", "{", "[1]", '{"schema": "sysid_btr.result/2"}', "{}"], ids=["empty", "cut", "list", "2", "none"]
)
def test_what_is_no_result_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "result.json").write_text(text)
    with pytest.raises(UsageError, match=r"result\.json"):
        read_result(tmp_path)


def test_exit_code_tells_a_finding_from_a_failure(study: Study) -> None:
    result = closing(study).to_dict()
    assert exit_code(result) == 0
    assert exit_code({**result, "effects": []}) == 5
    assert exit_code({**result, "effects": [], "parameters": []}) == 0
    assert exit_code({**result, "converged": False}) == 5
    told = {**result["parameters"][0], "identifiable": "weak"}
    assert exit_code({**result, "effects": [], "parameters": [*result["parameters"], told]}) == 0


@pytest.mark.parametrize("verdict", ["explained", "partly_explained", "nothing_missing", "ambiguous", "unexplained"])
def test_the_report_holds_every_finding_and_escapes_names(study: Study, verdict: str) -> None:
    result = closing(study, verdict=verdict, message="a <b>bold</b> claim").to_dict()
    page = render(result, [Picture("overlay", "how to read it", b"light", b"dark")])
    for text in ("mass:arm", "hardly any sensor responds", "coulomb_friction", "stribeck_friction", "direction 94 %"):
        assert text in page
    assert "<b>" not in page
    assert "dry friction at &lt;hinge&gt;" in page
    assert "prefers-color-scheme: dark" in page
    for outside in ("http:", "https:", 'src="/', "@import"):
        assert outside not in page


def test_tables_name_effect_interval_and_reason(study: Study, capsys: pytest.CaptureFixture[str]) -> None:
    import sys

    show(closing(study, verdict="ambiguous").to_dict(), console(sys.stdout))
    text = capsys.readouterr().out
    for part in (
        "dry friction at <hinge>",
        "93 % certain",
        "spring 5 %",
        "provisional",
        "not identifiable",
        "hardly any sensor",
        "0.280 .. 0.320",
        "mrad",
        "left at joint",
        "0.115 Nm",
        "position and direction 94 %",
    ):
        assert part in text
    assert "None" not in text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.000612, "rad", "0.612 mrad"),
        (0.0123, "rad", "12.3 mrad"),
        (2.15e-6, "m", "2.15 µm"),
        (0.0, "rad", "0 rad"),
        (1.2, "1", "1.2"),
        (95.1, "kg", "95.1 kg"),
        (None, "rad", "unknown"),
        (math.nan, "rad", "unknown"),
    ],
)
def test_numbers_for_people(value: float | None, unit: str, text: str) -> None:
    assert si(value, unit) in (text, text.replace("0.612 m", "612 µ"))


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (0.99987, 0.00017, "0.99987"),
        (1.267, 0.014, "1.267"),
        (200.31, 6.7, "200.3"),
        (95108.9, 230.0, "9.511e+04"),
        (1.0, 0.0, "1"),
        (None, 0.1, "-"),
    ],
)
def test_a_value_shows_the_digits_it_has(value: float | None, std: float, text: str) -> None:
    assert with_digits_of(value, std) == text


def test_compared_numbers_share_a_prefix() -> None:
    assert si_all([2.29e-3, 5.96e-4, None], "rad") == ["2.29 mrad", "0.596 mrad", "unknown"]


def test_what_json_cannot_hold_is_an_error() -> None:
    with pytest.raises(TypeError, match="object"):
        clean({"x": object()})
