"""What MuJoCo's own elements hold of terms that change more than fields, and what they cannot hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING, ClassVar, Literal

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Term
from sysid_btr.terms.disturbance import ConstantForce
from sysid_btr.terms.inertial import Payload
from sysid_btr.terms.sensing import EncoderOffsetInLoop
from sysid_btr.terms.servo import CommandDelay

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.simulation.numerics import Numerics

Held = Literal["yes", "approximately", "no"]
SOFT = 1e-10
"""Stiffness, relative to its torque, 1/rad, of a spring so long that its torque is constant."""

REASONS: Mapping[str, str] = {
    "law": "a law of every time step",
    "shape_command": "a change of the commands before they reach the servo",
    "applied_torque": "a torque over time, from outside",
    "initial_state": "where this log's replay starts",
    "read_out": "a change of what the sensor shows",
}
"""Hook of a term -> what it is, where MJCF has no element for it."""


@dataclass(frozen=True)
class Part:
    """A term as a file holds it.

    Attributes
    ----------
    term, values : as replayed; values are (1, places, kinds).
    stand_in : what writes it into a model in the file's way, None for what leaves no trace.
    held : whether the file then moves as the replay did.
    how : what the file has in its place, or why it has not, in words.
    """

    term: Term
    values: FloatArray
    stand_in: Term | None
    held: Held
    how: str


@dataclass(frozen=True, eq=False)
class Beside:
    """What decides how a file can hold a term.

    Attributes
    ----------
    plain : the robot without any term.
    numerics : integrator and step of the file.
    later : terms that act after this one.
    fuses : whether the compiler makes one body of those that are welded together.
    """

    plain: mujoco.MjModel
    numerics: Numerics
    later: tuple[Term, ...]
    fuses: bool


def part_of(term: Term, values: FloatArray, beside: Beside) -> Part:
    """How a file holds one term, given its values (1, places, kinds)."""
    native = NATIVE.get(type(term))
    found = None if native is None else native(term, values[0], beside)
    if found is not None:
        stand_in, held, how = found
        return Part(term, values, stand_in, held, how)
    hooks = [reason for hook, reason in REASONS.items() if type(term).overrides(hook)]
    if not hooks:
        return Part(term, values, term, "yes", "")
    fields = type(term).overrides("model_fields") or type(term).overrides("edit_spec")
    return Part(term, values, term if fields else None, "no", " and ".join(hooks))


Found = tuple[Term | None, Held, str] | None


@dataclass(frozen=True)
class AddedBody(Term):
    """A payload as a body of its own, welded to the one that carries it."""

    loads: tuple[tuple[float, ...], ...] = ()

    name: ClassVar[str] = "payload"

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for place, (mass, *where, _) in zip(self.places, self.loads, strict=True):
            if mass > 0:
                body = spec.body(place).add_body(name=f"payload_{place}", pos=list(where))
                body.explicitinertial = True
                body.ipos, body.inertia = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        # not in the spec: what the compiler derives from masses, such as dampings, is that of the bare robot
        masses, inertias = batch.read("body_mass"), batch.read("body_inertia")
        for place, (mass, *_, inertia) in zip(self.places, self.loads, strict=True):
            if mass > 0:
                body = batch.model.body(f"payload_{place}").id
                masses[:, body], inertias[:, body] = mass, inertia
        loaded = any(mass > 0 for mass, *_ in self.loads)
        return {"body_mass": masses, "body_inertia": inertias} if loaded else {}


def _payload(term: Term, values: FloatArray, beside: Beside) -> Found:
    if beside.fuses or any(set(term.places) & set(m.places) and m.scope == "body" for m in beside.later):
        return None  # body and load become one, or what follows changes them together
    plain = beside.plain
    touching = {plain.body(int(b)).name for b in plain.geom_bodyid[(plain.geom_contype | plain.geom_conaffinity) != 0]}
    if touching & set(term.places):
        return None  # MuJoCo's contacts are as stiff as the body that touches is heavy at its own centre of mass
    loads = tuple(tuple(float(x) for x in row) for row in values)
    return AddedBody(places=term.places, loads=loads), "yes", "a body of its own"


@dataclass(frozen=True)
class ActuatorDelay(Term):
    """Delay of commands by MuJoCo's own buffer.

    A held command that is delayed by a fraction of a step counts with its mean over each step; linear
    interpolation in the buffer is just that. Runge-Kutta reads the buffer within the step as well: there half
    a step more keeps the mean, and what is left is of second order in the step.
    """

    delays: tuple[float, ...] = ()
    timestep: float = 0.0

    name: ClassVar[str] = "delay"

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        import mujoco

        for place, delay in zip(self.places, self.delays, strict=True):
            if delay <= 0:
                continue
            for actuator in spec.actuators:
                if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT and actuator.target == place:
                    actuator.delay += delay
                    actuator.nsample = ceil(actuator.delay / self.timestep - 1e-9) + 1
                    actuator.interp = 1


def _delay(term: Term, values: FloatArray, beside: Beside) -> Found:
    numerics = beside.numerics
    if any(_reshapes(m) and set(m.places) & set(term.places) for m in beside.later):
        return None
    stated = [_buffered(float(d), numerics) for d in values[:, 0]]
    if not any(delay for delay, _ in stated):
        return None
    stand_in = ActuatorDelay(places=term.places, delays=tuple(d for d, _ in stated), timestep=numerics.timestep)
    if all(exact for _, exact in stated):
        return stand_in, "yes", "the actuator's own delay"
    how = "the actuator's own delay, to the whole step where it is shorter than one and a half"
    if numerics.integrator == "RK4":
        how += ", and else half a step longer, because RK4 reads it within the step as well"
    return stand_in, "approximately", how


def _reshapes(term: Term) -> bool:
    """Whether it changes commands in a way that does not commute with a delay, as a constant shift does."""
    return type(term).overrides("shape_command") and not isinstance(term, EncoderOffsetInLoop)


def _buffered(delay: float, numerics: Numerics) -> tuple[float, bool]:
    """The delay to state, and whether it does just what the replay did; a buffer knows no newer than a step ago."""
    h = numerics.timestep
    if delay == 0 or abs(delay - h) < 1e-9 * h:
        return (h if delay else 0.0), True
    if numerics.integrator != "RK4" and delay > h:
        return delay, True
    if delay >= 1.5 * h:
        return delay + 0.5 * h, False
    return (h if delay >= 0.5 * h else 0.0), False


@dataclass(frozen=True)
class SoftSpring(Term):
    """A constant torque as a spring that is too long to notice the motion."""

    torques: tuple[float, ...] = ()

    name: ClassVar[str] = "constant_force"

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        stiffness, rest = batch.read("jnt_stiffness"), batch.read("qpos_spring")
        for place, torque in zip(self.places, self.torques, strict=True):
            joint = batch.model.joint(place).id
            at = int(batch.model.jnt_qposadr[joint])
            k = float(stiffness[0, joint])
            if k == 0:
                stiffness[:, joint] = k = SOFT * abs(torque)
                rest[:, at] = 0.0
            if torque:
                rest[:, at] += torque / k
        return {"jnt_stiffness": stiffness, "qpos_spring": rest}


def _constant(term: Term, values: FloatArray, beside: Beside) -> Found:
    if any(m.name == "joint_spring" for m in beside.later):
        return None
    torques = tuple(float(t) for t in values[:, 0])
    how = "a spring on the joint, so soft and so long that its torque is constant"
    return SoftSpring(places=term.places, torques=torques), "yes", how


@dataclass(frozen=True)
class ShiftedJoint(Term):
    """A joint whose angle is what its encoder shows: the zero of the angle is shifted, not the robot."""

    offsets: tuple[float, ...] = ()

    name: ClassVar[str] = "encoder_offset"

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        zero, rest, limits = batch.read("qpos0"), batch.read("qpos_spring"), batch.read("jnt_range")
        for place, offset in zip(self.places, self.offsets, strict=True):
            joint = batch.model.joint(place).id
            at = int(batch.model.jnt_qposadr[joint])
            zero[:, at] += offset
            rest[:, at] += offset
            if batch.model.jnt_limited[joint]:
                limits[:, joint] += offset
        return {"qpos0": zero, "qpos_spring": rest, "jnt_range": limits}


def _reference(term: Term, values: FloatArray, beside: Beside) -> Found:
    if any(m.name in ("joint_spring", "encoder_scale") for m in beside.later):
        return None
    offsets = tuple(float(b) for b in values[:, 0])
    return ShiftedJoint(places=term.places, offsets=offsets), "yes", "the joint's reference angle"


Native = Callable[["Term", FloatArray, Beside], Found]
NATIVE: Mapping[type[Term], Native] = {
    Payload: _payload,
    CommandDelay: _delay,
    ConstantForce: _constant,
    EncoderOffsetInLoop: _reference,
}
"""Terms for which MuJoCo has an element of its own, though the replay goes another way."""
