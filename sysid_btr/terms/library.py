"""All effects, in the order in which they are tried; add a class here to add an effect."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from sysid_btr.errors import UsageError
from sysid_btr.terms.contact import FootCompliance, FootFriction
from sysid_btr.terms.disturbance import (
    ConstantForce,
    DriveDisturbanceTrain,
    ExternalDisturbance,
    ExternalDisturbanceTrain,
)
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.friction import (
    CoulombFriction,
    LoadFriction,
    LoadFrictionLarger,
    LoadFrictionQuadratic,
    LoadFrictionStribeck,
    QuadraticDamping,
    StribeckFriction,
    ViscousDamping,
)
from sysid_btr.terms.inertial import Armature, ComOffset, GravityTilt, Payload
from sysid_btr.terms.limits import SlewLimit, SpeedTorqueLimit, TorqueLimit
from sysid_btr.terms.power import ThermalDerating, VoltageSag, VoltageSagLoad
from sysid_btr.terms.sensing import EncoderOffset, EncoderOffsetInLoop, EncoderScale, EncoderScaleInLoop, SensorDelay
from sysid_btr.terms.servo import BackEmf, CommandDelay, IntegralGain
from sysid_btr.terms.spring import JointSpring
from sysid_btr.terms.transmission import Backlash, BacklashMotor, Cogging, JointCompliance, JointComplianceMotor

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
