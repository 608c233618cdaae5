"""All terms, built in or installed by other packages: what can be freed by name, and what `close` looks for."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence

from sysid_btr.errors import UsageError
from sysid_btr.plugins import installed, load_installed
from sysid_btr.terms.base import Term
from sysid_btr.terms.contact import FootCompliance, FootFriction
from sysid_btr.terms.coupling import DriveCoupling, DriveCouplingDifference
from sysid_btr.terms.disturbance import (
    ConstantForce,
    DriveDisturbanceTrain,
    ExternalDisturbance,
    ExternalDisturbanceTrain,
    RingingDisturbance,
    RingingDisturbanceTrain,
)
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.free_form import FREE_FORMS, FreeGainOfAll, FreeGainStiffness
from sysid_btr.terms.friction import (
    CoulombFriction,
    DampingFactor,
    LoadFriction,
    LoadFrictionLarger,
    LoadFrictionPower,
    LoadFrictionStribeck,
    PreslidingFriction,
    QuadraticDamping,
    StribeckFriction,
    ViscousDamping,
)
from sysid_btr.terms.inertial import Armature, ArmatureFactor, ComOffset, GravityTilt, Inertia, Mass, Payload
from sysid_btr.terms.initial_state import StartPosition, StartVelocity
from sysid_btr.terms.limits import SlewLimit, SpeedTorqueLimit, TorqueLimit, TorqueLimitSoft
from sysid_btr.terms.power import ThermalDerating, VoltageSag, VoltageSagLoad, VoltageSagLoadStiffness
from sysid_btr.terms.sensing import (
    EncoderCyclicError,
    EncoderOffset,
    EncoderOffsetInLoop,
    EncoderScale,
    EncoderScaleInLoop,
    SensorDelay,
    TorqueOffset,
    TorqueScale,
)
from sysid_btr.terms.servo import (
    ActuatorFilter,
    BackEmf,
    CommandDelay,
    CommandDelaySampled,
    IntegralGain,
    Kp,
    Kv,
    TorqueConstant,
)
from sysid_btr.terms.spring import JointSpring, JointStop, JointStopBelow, Tether
from sysid_btr.terms.transmission import (
    Backlash,
    BacklashGreased,
    BacklashMotor,
    Cogging,
    JointCompliance,
    JointComplianceMotor,
)

ENTRY_POINTS = "sysid_btr.terms"
"""Entry-point group; each entry is a class of terms, under its name."""

BUILT_IN: tuple[type[Term], ...] = (
    Mass,
    Inertia,
    Kp,
    Kv,
    TorqueConstant,
    CoulombFriction,
    ViscousDamping,
    DampingFactor,
    QuadraticDamping,
    StribeckFriction,
    PreslidingFriction,
    LoadFriction,
    LoadFrictionLarger,
    LoadFrictionPower,
    LoadFrictionStribeck,
    BackEmf,
    Armature,
    ArmatureFactor,
    CommandDelay,
    CommandDelaySampled,
    ActuatorFilter,
    SensorDelay,
    DriveCoupling,
    DriveCouplingDifference,
    Backlash,
    BacklashMotor,
    BacklashGreased,
    JointCompliance,
    JointComplianceMotor,
    JointSpring,
    JointStop,
    JointStopBelow,
    Tether,
    EncoderOffset,
    EncoderOffsetInLoop,
    EncoderScale,
    EncoderScaleInLoop,
    TorqueOffset,
    TorqueScale,
    TorqueLimit,
    TorqueLimitSoft,
    SpeedTorqueLimit,
    SlewLimit,
    IntegralGain,
    VoltageSag,
    VoltageSagLoad,
    VoltageSagLoadStiffness,
    FreeGainOfAll,
    FreeGainStiffness,
    ThermalDerating,
    Payload,
    ComOffset,
    ConstantForce,
    Cogging,
    EncoderCyclicError,
    ExternalDisturbance,
    ExternalDisturbanceTrain,
    DriveDisturbanceTrain,
    RingingDisturbance,
    RingingDisturbanceTrain,
    *FREE_FORMS,
    GravityTilt,
    FootFriction,
    FootCompliance,
    StartPosition,
    StartVelocity,
)
"""In the order in which they are tried."""


def all_terms() -> tuple[type[Term], ...]:
    """Every term, the installed ones last.

    Raises
    ------
    UsageError
        If one is installed but cannot be loaded, or is not a term.
    """
    more: list[type[Term]] = []
    for name in sorted(installed(ENTRY_POINTS)):
        found = load_installed(ENTRY_POINTS, name, "term")
        if not (isinstance(found, type) and issubclass(found, Term)):
            raise UsageError(f"term {name!r} is installed but is not a class derived from Term: {found!r}")
        more.append(found)
    return (*BUILT_IN, *more)


def declarable(more: Mapping[str, type[Term]]) -> dict[str, type[Term]]:
    """Terms by the names under which they can be freed: of the model's own value, of the term, of its variant.

    `more` are those that one robot alone has.
    """
    table: dict[str, type[Term]] = {}
    for cls in all_terms():
        for name in (cls.field, cls.name, *cls.also, f"{cls.name}.{cls.variant}"):
            if name and not name.endswith("."):
                table.setdefault(name, cls)
    return {**table, **more}


def effects() -> tuple[type[Effect], ...]:
    """All effects that a model may lack."""
    return tuple(cls for cls in all_terms() if issubclass(cls, Effect))


def effect_names() -> tuple[str, ...]:
    """Names of all effects, each once."""
    return tuple(dict.fromkeys(e.name for e in effects()))


def select_effects(names: Sequence[str]) -> tuple[type[Effect], ...]:
    """Effects by name, also by the one of the model's own value; ``all`` for the usual ones.

    Raises
    ------
    UsageError
        Naming what is unknown, and what there is.
    """
    there = effects()
    if "all" in names:
        return tuple(e for e in there if e.usual or e.name in names)
    called = {other: e.name for e in there for other in (e.name, *e.also, *([e.field] if e.field else []))}
    unknown = [n for n in names if n not in called]
    if unknown:
        hints = [difflib.get_close_matches(n, called, n=1) or [c for c in called if n in c] for n in unknown]
        listed = ", ".join(
            f"{n!r}" + (f" (did you mean {' or '.join(map(repr, h))}?)" if h else "")
            for n, h in zip(unknown, hints, strict=True)
        )
        known = "" if all(hints) else f"; effects are {', '.join(effect_names())}, or all"
        raise UsageError(f"unknown effect {listed}{known}")
    wanted = {called[n] for n in names}
    return tuple(e for e in there if e.name in wanted)
