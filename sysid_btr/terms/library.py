"""All effects, in the order in which they are tried; add a class here to add an effect."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from sysid_btr.errors import UsageError
from sysid_btr.terms.armature import Armature
from sysid_btr.terms.back_emf import BackEmf
from sysid_btr.terms.backlash import Backlash, BacklashMotor
from sysid_btr.terms.cogging import Cogging
from sysid_btr.terms.com_offset import ComOffset
from sysid_btr.terms.command_delay import CommandDelay
from sysid_btr.terms.constant_force import ConstantForce
from sysid_btr.terms.coulomb_friction import CoulombFriction
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.encoder_offset import EncoderOffset, EncoderOffsetInLoop
from sysid_btr.terms.encoder_scale import EncoderScale, EncoderScaleInLoop
from sysid_btr.terms.external_disturbance import (
    DriveDisturbanceTrain,
    ExternalDisturbance,
    ExternalDisturbanceTrain,
)
from sysid_btr.terms.foot_compliance import FootCompliance
from sysid_btr.terms.foot_friction import FootFriction
from sysid_btr.terms.gravity_tilt import GravityTilt
from sysid_btr.terms.integral_gain import IntegralGain
from sysid_btr.terms.joint_compliance import JointCompliance, JointComplianceMotor
from sysid_btr.terms.joint_spring import JointSpring
from sysid_btr.terms.load_friction import (
    LoadFriction,
    LoadFrictionLarger,
    LoadFrictionQuadratic,
    LoadFrictionStribeck,
)
from sysid_btr.terms.payload import Payload
from sysid_btr.terms.quadratic_damping import QuadraticDamping
from sysid_btr.terms.sensor_delay import SensorDelay
from sysid_btr.terms.slew_limit import SlewLimit
from sysid_btr.terms.speed_torque_limit import SpeedTorqueLimit
from sysid_btr.terms.stribeck_friction import StribeckFriction
from sysid_btr.terms.thermal_derating import ThermalDerating
from sysid_btr.terms.torque_limit import TorqueLimit
from sysid_btr.terms.viscous_damping import ViscousDamping
from sysid_btr.terms.voltage_sag import VoltageSag, VoltageSagLoad

EFFECTS: tuple[type[Effect], ...] = (
    CoulombFriction,
    ViscousDamping,
    QuadraticDamping,
    StribeckFriction,
    LoadFriction,
    LoadFrictionLarger,
    LoadFrictionQuadratic,
    LoadFrictionStribeck,
    BackEmf,
    Armature,
    CommandDelay,
    SensorDelay,
    Backlash,
    BacklashMotor,
    JointCompliance,
    JointComplianceMotor,
    JointSpring,
    EncoderOffset,
    EncoderOffsetInLoop,
    EncoderScale,
    EncoderScaleInLoop,
    TorqueLimit,
    SpeedTorqueLimit,
    SlewLimit,
    IntegralGain,
    VoltageSag,
    VoltageSagLoad,
    ThermalDerating,
    Payload,
    ComOffset,
    ConstantForce,
    Cogging,
    ExternalDisturbance,
    ExternalDisturbanceTrain,
    DriveDisturbanceTrain,
    GravityTilt,
    FootFriction,
    FootCompliance,
)


def effect_names() -> tuple[str, ...]:
    """Names of all effects, each once."""
    return tuple(dict.fromkeys(e.name for e in EFFECTS))


def select_effects(names: Sequence[str]) -> tuple[type[Effect], ...]:
    """Effects by name; ``all`` for all.

    Raises
    ------
    UsageError
        Naming what is unknown, and what there is.
    """
    known = effect_names()
    if "all" in names:
        return EFFECTS
    unknown = [n for n in names if n not in known]
    if unknown:
        hints = [difflib.get_close_matches(n, known, n=1) for n in unknown]
        listed = ", ".join(
            f"{n!r}" + (f" (did you mean {h[0]!r}?)" if h else "")
            for n, h in zip(unknown, hints, strict=True)
        )
        raise UsageError(f"unknown effect {listed}; effects are {', '.join(known)}, or all")
    return tuple(e for e in EFFECTS if e.name in names)
