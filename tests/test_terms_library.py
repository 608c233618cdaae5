"""What every effect must be: neutral by default, bounded, documented, and visible when it is large."""

from __future__ import annotations

import numpy as np
import pytest
from toys import FINE, LEG_JOINTS, SCALE, leg, make_log, position, robot_from_xml, run, swing

from sysid_btr.errors import UsageError
from sysid_btr.io.log import Log
from sysid_btr.models.robot import Robot
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.library import effect_names, effects, select_effects
from sysid_btr.terms.scales import Scales
from sysid_btr.terms.transmission import JointCompliance

LOG = swing(LEG_JOINTS, seconds=0.8)
EFFECTS = effects()
SCALES: Scales = dict.fromkeys(LEG_JOINTS, SCALE)
STRUCTURAL = 2e-4
"""rad; a second joint that is held is nearly, not exactly, no joint."""

NAMES = """
    coulomb_friction viscous_damping quadratic_damping stribeck_friction load_friction armature
    command_delay sensor_delay backlash joint_compliance joint_spring encoder_offset encoder_scale
    torque_limit speed_torque_limit slew_limit integral_gain voltage_sag thermal_derating payload
    com_offset constant_force cogging external_disturbance gravity_tilt foot_friction foot_compliance
"""

SLIDER = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <body name="box" pos="0 0 .05">
    <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
    <geom type="box" size=".05 .05 .05" mass="1"/></body>
</worldbody></mujoco>
"""


def sliding() -> tuple[Robot, Log]:
    """A box that slides over the ground, and falls onto it first."""
    n = 41
    channels = {
        "position.x": np.zeros(n),
        "velocity.x": np.full(n, 3.0),
        "position.z": np.full(n, 0.01),
        "velocity.z": np.zeros(n),
    }
    return robot_from_xml(SLIDER), make_log(np.arange(n) * 0.005, channels)


def label(effect: type[Effect]) -> str:
    return f"{effect.name}-{effect.variant}" if effect.variant else effect.name


def place(effect: type[Effect]) -> str:
    return "robot" if effect.scope == "robot" else "knee"


def at_knee(effect: type[Effect]) -> Effect:
    return effect.at((place(effect),), SCALES)


def realistic(effect: type[Effect]) -> np.ndarray:
    """Values (kinds,) of a clear case of the effect."""
    special: dict[str, tuple[float, ...]] = {
        "cogging": (0.3, 0.2, 20.0),
        "external_disturbance": (1.0, 0.3, 0.05),
        "speed_torque_limit": (0.4, 5.0),
        "thermal_derating": (2.0, 1.0),
    }
    if label(effect) == "voltage_sag-time":
        return np.array([0.05])
    if effect.variant in ("train", "drive_train"):
        return np.array([1.0, 0.3, 0.05, 0.2])
    if effect.name in special:
        return np.array(special[effect.name])
    return np.array(effect.probes(SCALE)[-1][-1])


every_effect = pytest.mark.parametrize("effect", EFFECTS, ids=label)


def test_every_promised_effect_is_there() -> None:
    assert set(NAMES.split()) <= set(effect_names())
    assert len({(e.name, e.variant) for e in EFFECTS}) == len(EFFECTS)


def test_effects_are_chosen_by_name_and_a_wrong_name_is_told() -> None:
    usual = {e.name for e in select_effects(["all"])}
    assert set(NAMES.split()) <= usual
    assert usual.isdisjoint({"mass", "inertia", "kp", "kv", "torque_constant"}), "what the user declares"
    assert [e.name for e in select_effects(["kp", "frictionloss", "delay"])] == [
        "kp", "coulomb_friction", "command_delay"
    ]  # fmt: skip
    assert {e.name for e in select_effects(["backlash", "payload"])} == {"backlash", "payload"}
    with pytest.raises(UsageError, match=r"'backlsh' \(did you mean 'backlash'\?\).*coulomb_friction"):
        select_effects(["backlsh"])


@every_effect
def test_an_effect_says_what_it_is(effect: type[Effect]) -> None:
    assert effect.name
    assert effect.title
    assert effect.title[0].islower()
    assert effect.__doc__
    assert effect.needs
    assert effect.confounders, "what else leaves such a trace, and what tells the two apart"
    assert 0 <= effect.main < len(effect.kinds)
    assert set(effect.held) <= {k.name for k in effect.kinds}


@every_effect
def test_bounds_hold_the_neutral_value(effect: type[Effect]) -> None:
    for parameter in at_knee(effect).parameters:
        assert parameter.lower <= parameter.nominal <= parameter.upper
        assert 0 < parameter.scale < parameter.upper - parameter.lower
        assert np.isfinite([parameter.lower, parameter.upper]).all()
        assert parameter.unit


@every_effect
def test_probes_are_legal_values_other_than_neutral(effect: type[Effect]) -> None:
    kinds = effect.sized(SCALE)
    for probe in effect.probes(SCALE):
        for values in probe:
            assert len(values) == len(kinds)
            assert any(v != k.nominal for v, k in zip(values, kinds, strict=True))
            assert all(k.lower <= v <= k.upper for v, k in zip(values, kinds, strict=True))


@every_effect
def test_a_neutral_effect_is_no_effect(effect: type[Effect]) -> None:
    numerics = Numerics("RK4", 0.00125) if effect.name == "joint_compliance" else FINE
    neutral = position(leg(), LOG, [at_knee(effect)], numerics=numerics)
    tolerance = STRUCTURAL if effect.structural else 1e-12
    np.testing.assert_allclose(neutral, position(leg(), LOG, numerics=numerics), rtol=0, atol=tolerance)


def test_the_stiffest_gear_gets_stiffer_with_a_finer_step() -> None:
    """What a step cannot resolve of a stiff spring goes with its square, and never diverges."""

    def twist(step: float) -> float:
        numerics = Numerics("RK4", step)
        rigid = position(leg(), LOG, numerics=numerics)
        return float(
            np.abs(position(leg(), LOG, [at_knee(JointCompliance)], numerics=numerics) - rigid).max()
        )

    coarse, fine = twist(0.005), twist(0.00125)
    assert coarse < 5e-3
    assert fine < coarse / 10


@every_effect
def test_a_neutral_candidate_is_not_disturbed_by_its_neighbours(effect: type[Effect]) -> None:
    term = at_knee(effect)
    together = run(leg(), LOG, [term], np.stack([term.neutral, realistic(effect)]))
    alone = run(leg(), LOG, [term], term.neutral)
    np.testing.assert_array_equal(together.position[0], alone.position[0])


@every_effect
def test_a_realistic_effect_changes_the_replay(effect: type[Effect]) -> None:
    robot, log = sliding() if effect.name.startswith("foot_") else (leg(), LOG)
    term = at_knee(effect)
    outputs = run(robot, log, [term], np.stack([term.neutral, realistic(effect)]))
    assert np.isfinite(outputs.position).all()
    assert np.abs(outputs.position[1] - outputs.position[0]).max() > 1e-4


@pytest.mark.parametrize("effect", [e for e in EFFECTS if e.scope != "robot"], ids=label)
def test_one_shared_amount_equals_the_same_amount_everywhere(effect: type[Effect]) -> None:
    places = ("hip", "knee")
    values = realistic(effect)
    shared = effect.at(places, SCALES, shared=True)
    apart = effect.at(places, SCALES)
    assert len(apart.parameters) == 2 * len(shared.parameters)
    np.testing.assert_allclose(
        position(leg(), LOG, [shared], values), position(leg(), LOG, [apart], np.tile(values, 2)), atol=1e-12
    )
