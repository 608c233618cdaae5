"""What every term must be: described, bounded, neutral by default, visible when it is large, written as it moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from toys import LEG_JOINTS, SCALE, leg, position, swing

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import UsageError
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.base import Kind, Term
from sysid_btr.terms.disturbance import ConstantForce
from sysid_btr.terms.free_form import FreeTorquePosition
from sysid_btr.terms.friction import CoulombFriction, LoadFriction
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.law import Step
from sysid_btr.terms.library import all_terms, effect_names, select_effects
from sysid_btr.terms.scales import Scales
from sysid_btr.terms.transmission import JointCompliance
from sysid_btr.testing import TERM_CHECKS, TermBench, check_term, toy_motion, toy_robot

LOG = swing(LEG_JOINTS, seconds=0.8)
SCALES: Scales = dict.fromkeys(LEG_JOINTS, SCALE)

NAMES = """
    coulomb_friction viscous_damping quadratic_damping stribeck_friction load_friction armature
    command_delay sensor_delay backlash joint_compliance joint_spring joint_stop encoder_offset
    encoder_scale encoder_cyclic_error
    torque_limit speed_torque_limit slew_limit integral_gain voltage_sag thermal_derating payload
    com_offset constant_force cogging external_disturbance gravity_tilt foot_friction foot_compliance
"""


@pytest.fixture(scope="module")
def bench() -> TermBench:
    return TermBench.of(toy_robot(), toy_motion())


def label(cls: type[Term]) -> str:
    return f"{cls.name}-{cls.variant}" if cls.variant else cls.name


@pytest.mark.parametrize("check", TERM_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("cls", all_terms(), ids=label)
def test_conformance(cls: type[Term], check: Callable[[type[Term], TermBench], None], bench: TermBench) -> None:
    check(cls, bench)


def test_every_promised_effect_is_there() -> None:
    assert set(NAMES.split()) <= set(effect_names())
    assert len({(t.name, t.variant) for t in all_terms()}) == len(all_terms())


def test_a_torque_at_a_slide_is_called_a_force(bench: TermBench) -> None:
    called = {place: ConstantForce.at((place,), bench.study.scales).described for place in ("hip", "slide")}
    assert called == {"hip": "constant torque", "slide": "constant force"}
    assert FreeTorquePosition.at(("slide",), bench.study.scales).axes == ("position (m)", "force (N)")


def test_effects_are_chosen_by_name_and_a_wrong_name_is_told() -> None:
    usual = {e.name for e in select_effects(["all"])}
    assert set(NAMES.split()) <= usual
    assert usual.isdisjoint({"mass", "inertia", "kv", "torque_constant"}), "what the user declares"
    assert "kp" in usual, "a servo that is weaker than the model says"
    named = [(e.name, e.variant) for e in select_effects(["kp", "frictionloss", "delay"])]
    friction = [("coulomb_friction", ""), ("coulomb_friction", "presliding")]
    assert named == [("kp", ""), *friction, ("command_delay", ""), ("command_delay", "sampled")]
    assert {e.name for e in select_effects(["backlash", "payload"])} == {"backlash", "payload"}
    with pytest.raises(UsageError, match=r"'backlsh' \(did you mean 'backlash'\?\)$"):
        select_effects(["backlsh"])
    with pytest.raises(UsageError, match=r"'zzz'; effects are .*coulomb_friction"):
        select_effects(["zzz"])


@dataclass(frozen=True)
class NotNeutral(CoulombFriction):
    """Half of what is asked for, and a little more.

    Native: `dof_frictionloss`.
    """

    def changed(self, present: FloatArray, values: FloatArray) -> FloatArray:
        return present + values + 0.01


@dataclass(frozen=True)
class Idle(CoulombFriction):
    """Nothing at all."""

    def changed(self, present: FloatArray, values: FloatArray) -> FloatArray:
        return present


@dataclass(frozen=True)
class Neighbourly(CoulombFriction):
    """The mean over all candidates."""

    def changed(self, present: FloatArray, values: FloatArray) -> FloatArray:
        return present + values.mean()


@dataclass(frozen=True)
class Undescribed(CoulombFriction):
    """A change of a unit that is none."""

    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "furlong", 0.0, 0.0, 10.0, 0.05),)


@dataclass(frozen=True)
class Joining(LoadFriction):
    """Friction at each joint that follows the torques of all.

    Law: adds to the friction.
    """

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            for k in places:
                step.friction[j] += numbers[p, 0] * abs(step.torque[k])


@pytest.mark.parametrize(
    ("cls", "promise"),
    [
        (Joining, "what its law does at .* depends on another: give it scope robot"),
        (NotNeutral, "its neutral value changes the plain model"),
        (Idle, "changes nothing"),
        (Neighbourly, "moves otherwise beside another candidate|neutral value changes"),
        (Undescribed, "'furlong' is not a unit"),
    ],
)
def test_a_broken_term_is_caught(cls: type[Term], promise: str) -> None:
    with pytest.raises(AssertionError, match=promise):
        check_term(cls)


def test_no_encoder_closes_the_loop_of_a_joint_without_a_servo(bench: TermBench) -> None:
    with pytest.raises(UsageError, match=r"'slide' matches no joint with a servo .* there are: hip, knee"):
        parse_parameters(["encoder_scale.loop:slide"], bench.study.robot)


def test_the_stiffest_gear_gets_stiffer_with_a_finer_step() -> None:
    """What a step cannot resolve of a stiff spring goes with its square, and never diverges."""

    def twist(step: float) -> float:
        numerics = Numerics("RK4", step)
        rigid = position(leg(), LOG, numerics=numerics)
        return float(
            np.abs(position(leg(), LOG, [JointCompliance.at(("knee",), SCALES)], numerics=numerics) - rigid).max()
        )

    coarse, fine = twist(0.005), twist(0.00125)
    assert coarse < 5e-3
    assert fine < coarse / 10
