"""The parameter grammar: what it accepts, how it groups, and what its errors tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from toys import SCALE, leg, pendulum

from sysid_btr.errors import UsageError
from sysid_btr.models.emps import emps
from sysid_btr.models.nao import PAPER_BOUNDS, STARRED, nao
from sysid_btr.terms.base import Term
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.library import all_terms, declarable
from sysid_btr.terms.scales import JointScale

LEG = leg()
NAO = nao()


def names(*expressions: str) -> list[str]:
    return [p.name for m in parse_parameters(expressions, LEG) for p in m.parameters]


def test_globs_match_in_model_order_and_each_name_once() -> None:
    assert names("mass:*") == ["mass:hip", "mass:knee", "mass:ankle"]
    assert names("kp:k*,*p,knee") == ["kp:knee", "kp:hip"]
    assert names("damping:[hk]*") == ["damping:hip", "damping:knee"]


def test_shared_is_one_number_for_all_matches() -> None:
    (term,) = parse_parameters(["kp:*=shared"], LEG)
    assert term.places == ("hip", "knee", "ankle")
    assert [p.name for p in term.parameters] == ["kp:*"]
    (single,) = parse_parameters(["kp:knee=shared"], LEG)
    assert len(single.parameters) == 1


def test_a_centre_of_mass_is_three_numbers_a_body() -> None:
    assert names("com:knee") == ["com.x:knee", "com.y:knee", "com.z:knee"]
    assert names("com.z:knee", "com.x:knee") == ["com.z:knee", "com.x:knee"]


def test_a_name_of_the_models_own_value_and_one_of_its_change_are_one_term() -> None:
    (own,) = parse_parameters(["damping:knee"], LEG)
    (change,) = parse_parameters(["viscous_damping:knee"], LEG)
    assert type(own) is type(change)
    assert (own.absolute, change.absolute) == (True, False)
    assert [m.parameters[0].nominal for m in (own, change)] == [0.05, 0.0]
    with pytest.raises(UsageError, match=r"viscous_damping:knee is already declared by 'damping:\*'"):
        parse_parameters(["damping:*", "viscous_damping:knee"], LEG)


def test_every_effect_can_be_freed_whole_in_part_and_by_its_variant() -> None:
    assert names("backlash:k*") == ["backlash.play:knee", "backlash.softness:knee"]
    (part,) = parse_parameters(["backlash.play:*=shared"], LEG, {"knee": SCALE})
    assert [p.name for p in part.parameters] == ["backlash.play:*"]
    assert part.spread(np.array([[0.02]])).tolist() == [[[0.02, 0.0]] * 3]
    (motor,) = parse_parameters(["backlash.motor:knee"], LEG)
    assert motor.variant == "motor"
    assert names("load_friction.stribeck.ratio:hip") == ["load_friction.stribeck.ratio:hip"]
    assert names("gravity_tilt:*") == ["gravity_tilt.x:robot", "gravity_tilt.y:robot"]
    with pytest.raises(UsageError, match="backlash has no 'slip'; it has play, softness"):
        parse_parameters(["backlash.slip:knee"], LEG)


@pytest.mark.parametrize(
    ("expression", "told"),
    [
        ("mass:toe", ("'toe'", "body", "hip, knee, ankle")),
        ("kp:elbow", ("'elbow'", "joint with a servo", "hip, knee, ankle")),
        ("mas:knee", ("'mas'", "did you mean 'mass'", "lists all")),
        ("zzz:knee", ("'zzz'", "fields are mass", "frictionloss")),
        ("mass", ("FIELD:GLOB",)),
        ("mass:", ("FIELD:GLOB",)),
        ("mass:knee=same", ("'same'", "shared")),
        ("mass:knee,,hip", ("''", "body")),
    ],
)
def test_an_error_says_what_is_wrong_and_what_there_is(expression: str, told: tuple[str, ...]) -> None:
    with pytest.raises(UsageError) as caught:
        parse_parameters([expression], LEG)
    message = str(caught.value)
    assert f"--fit {expression}" in message
    for part in told:
        assert part in message


def test_all_problems_are_told_at_once() -> None:
    with pytest.raises(UsageError) as caught:
        parse_parameters(["mass:toe", "kp:*", "nonsense:*", "kp:knee"], LEG)
    message = str(caught.value)
    assert all(part in message for part in ("'toe'", "'nonsense'", "kp:knee is already declared by 'kp:*'"))


PLACES = st.lists(st.sampled_from(["hip", "knee", "ankle", "*", "k*"]), min_size=1, max_size=3).map(",".join)
EXPRESSIONS = st.lists(
    st.tuples(st.sampled_from(["mass", "kp", "damping"]), PLACES, st.sampled_from(["", "=shared"])).map(
        lambda t: f"{t[0]}:{t[1]}{t[2]}"
    ),
    min_size=1,
    max_size=4,
)


@given(EXPRESSIONS)
def test_no_number_is_ever_freed_twice(expressions: list[str]) -> None:
    try:
        terms = parse_parameters(expressions, LEG)
    except UsageError as error:
        assert "already declared" in str(error)  # noqa: PT017 - a success is checked below
        return
    freed = [(m.name, place) for m in terms for place in m.places]
    assert len(freed) == len(set(freed))
    labels = [p.name for m in terms for p in m.parameters]
    assert len(labels) == len(set(labels))


@pytest.mark.parametrize("field", sorted(declarable({})))
@pytest.mark.parametrize("sized", [False, True])
def test_bounds_hold_the_nominal_and_scales_are_positive(field: str, sized: bool) -> None:
    scales = {"knee": SCALE} if sized else None
    place = "robot" if declarable({})[field].scope == "robot" and not field.startswith("foot_") else "knee"
    for term in parse_parameters([f"{field}:{place}"], LEG, scales):
        for p in term.parameters:
            assert p.lower <= p.nominal <= p.upper
            assert p.lower < p.upper < float("inf")
            assert 0 < p.scale < p.upper - p.lower
            assert p.unit


def test_units_of_a_slide_are_those_of_forces_and_lengths() -> None:
    slide = replace(SCALE, slide=True)
    for scales in (None, {"slider": slide}):
        units = {
            p.name: p.unit
            for m in parse_parameters(["damping:*", "frictionloss:*", "constant_force:*", "qpos0:*"], emps(), scales)
            for p in m.parameters
        }
        assert units == {
            "damping:slider": "N s/m",
            "frictionloss:slider": "N",
            "constant_force:slider": "N",
            "qpos0:slider": "m",
        }


@pytest.mark.parametrize("cls", [t for t in all_terms() if t.scope in ("joint", "servo")], ids=lambda t: t.__name__)
def test_no_unit_of_a_slide_is_that_of_a_hinge(cls: type[Term]) -> None:
    name = f"{cls.name}.{cls.variant}" if cls.variant else cls.name
    scales = {"slider": replace(SCALE, slide=True)}
    (declared,) = parse_parameters([f"{name}:slider"], emps(), scales)
    for p in (*declared.parameters, *cls.at(("slider",), scales).parameters):
        assert "Nm" not in p.unit
        assert "rad" not in p.unit


def test_joints_on_one_motor_have_one_gain() -> None:
    (term,) = parse_parameters(["kp:*HipYawPitch"], NAO)
    assert set(term.places) == {"RHipYawPitch", "LHipYawPitch"}
    assert len(term.parameters) == 1
    assert len(parse_parameters(["kp:*"], NAO)) == 21
    assert len(parse_parameters(["mass:*HipYawPitch"], NAO)) == 2, "two bodies on one motor have two masses"


def test_the_papers_search_space() -> None:
    robot = replace(NAO, bounds=PAPER_BOUNDS)
    parameters = [p for m in parse_parameters(["mass:" + ",".join(STARRED)], robot) for p in m.parameters]
    assert len(parameters) == 8
    assert all((p.lower, p.upper) == (0.5, 1.5) for p in parameters)
    (other,) = parse_parameters(["mass:Torso"], robot)
    assert other.parameters[0].upper == 3.0


@pytest.mark.parametrize("key", ["damping:arm", "damping", "damping:*", "damping:leg,a*"])
def test_a_robots_own_bounds_win(key: str) -> None:
    robot = replace(pendulum(), bounds={key: (0.01, 0.2)})
    scales: dict[str, JointScale] = {"arm": SCALE}
    (term,) = parse_parameters(["damping:arm"], robot, scales)
    assert (term.parameters[0].lower, term.parameters[0].upper) == (0.01, 0.2)


def test_of_bounds_the_closest_holds() -> None:
    table = {"mass": (0.1, 2.0), "mass:*": (0.2, 3.0), "mass:*Pitch": (0.3, 4.0), "mass:LHipPitch": (0.4, 5.0)}
    freed = ("mass:LHipPitch", "mass:RHipPitch", "mass:Torso", "kp:LHipPitch")
    terms = parse_parameters(freed, replace(NAO, bounds=table))
    named, ends, rest, other = (term.parameters[0] for term in terms)
    assert [p.lower for p in (named, ends, rest)] == [0.4, 0.3, 0.2]
    assert not other.stated
    for key in ("kp:L*", "kp:R*", "kp:RHipYawPitch"):
        (tied,) = parse_parameters(["kp:*HipYawPitch"], replace(NAO, bounds={key: (0.3, 4.0)}))
        assert tied.parameters[0].stated, "joints that one motor drives have one number"
    (alike,) = parse_parameters(["mass:*Pitch=shared"], replace(NAO, bounds={"mass:*Pitch": (0.3, 4.0)}))
    assert alike.parameters[0].lower == 0.3
    assert alike.parameters[0].stated


@pytest.mark.parametrize(
    ("bounds", "said"),
    [
        ({"mass": (-5.0, 5.0)}, "bounds -5 .. 5 of mass:knee: it cannot be negative"),
        ({"kp:knee": (-1.0, 2.0)}, "bounds -1 .. 2 of kp:knee: it cannot be negative"),
        ({"kp": (1e-300, 1e300)}, "cannot be searched"),
    ],
)
def test_bounds_that_nothing_can_have_are_refused(bounds: dict[str, tuple[float, float]], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        parse_parameters(["mass:knee", "kp:knee"], replace(LEG, bounds=bounds))
    (signed,) = parse_parameters(["com.x:knee"], replace(LEG, bounds={"com.x": (-0.1, 0.1)}))
    assert signed.parameters[0].lower == -0.1
