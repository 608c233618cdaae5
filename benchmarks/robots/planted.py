"""What a simulated robot has and its model lacks: planted by other means than the library's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class Planted:
    """One effect; each hook does nothing unless a kind of effect has it.

    Attributes
    ----------
    where : joints, or bodies.
    amount : how large, in the unit of `kind`.
    """

    where: tuple[str, ...]
    amount: float

    effect: ClassVar[str]
    kind: ClassVar[str]
    also: ClassVar[Mapping[str, str]] = {}
    """Other names of the same physics -> the kind of parameter that holds the amount."""

    def build(self, spec: mujoco.MjSpec) -> None:
        """Change the robot before it is compiled."""

    def torque(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Add to `data.qfrc_applied` (nv,)."""

    def sent(self, ctrl: FloatArray, period: float) -> FloatArray:
        """What reaches the actuators of ctrl (steps, nu), one row a simulation step of `period` s."""
        return ctrl

    def read(self, channels: dict[str, FloatArray]) -> None:
        """Change what sensors say, in place."""


@dataclass(frozen=True)
class DryFriction(Planted):
    """A smooth force against the motion, Nm: `amount` tanh(v / `width`), explicit."""

    width: float = 0.004

    effect: ClassVar[str] = "coulomb_friction"
    kind: ClassVar[str] = "torque"
    also: ClassVar[Mapping[str, str]] = {"stribeck_friction": "coulomb"}

    def torque(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for joint in self.where:
            d = model.joint(joint).dofadr[0]
            data.qfrc_applied[d] -= self.amount * np.tanh(data.qvel[d] / self.width)


@dataclass(frozen=True)
class Viscous(Planted):
    """Nm s/rad."""

    effect: ClassVar[str] = "viscous_damping"
    kind: ClassVar[str] = "b"
    also: ClassVar[Mapping[str, str]] = {"back_emf": "b"}

    def torque(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for joint in self.where:
            d = model.joint(joint).dofadr[0]
            data.qfrc_applied[d] -= self.amount * data.qvel[d]


@dataclass(frozen=True)
class Rotor(Planted):
    """Inertia of a rotor behind a gear, kg m2."""

    effect: ClassVar[str] = "armature"
    kind: ClassVar[str] = "inertia"

    def build(self, spec: mujoco.MjSpec) -> None:
        for joint in self.where:
            spec.joint(joint).armature += self.amount


@dataclass(frozen=True)
class Load(Planted):
    """A ball of `amount` kg, welded to a body at `offset` m in the body's frame."""

    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    effect: ClassVar[str] = "payload"
    kind: ClassVar[str] = "mass"

    def build(self, spec: mujoco.MjSpec) -> None:
        for body in self.where:
            ball = spec.body(body).add_body(name=f"{body}_load", pos=self.offset)
            ball.add_geom(size=[0.02, 0, 0], mass=self.amount, contype=0, conaffinity=0)


@dataclass(frozen=True)
class Late(Planted):
    """All commands arrive later, s."""

    effect: ClassVar[str] = "command_delay"
    kind: ClassVar[str] = "time"

    def sent(self, ctrl: FloatArray, period: float) -> FloatArray:
        steps = round(self.amount / period)
        return np.concatenate([np.repeat(ctrl[:1], steps, axis=0), ctrl])[: len(ctrl)]


@dataclass(frozen=True)
class Lag(Planted):
    """All commands pass a first-order filter, time constant in s."""

    effect: ClassVar[str] = "actuator_filter"
    kind: ClassVar[str] = "time"

    def sent(self, ctrl: FloatArray, period: float) -> FloatArray:
        from scipy.signal import lfilter

        keep = np.exp(-period / self.amount)
        held, _ = lfilter([0.0, 1.0 - keep], [1.0, -keep], ctrl, axis=0, zi=ctrl[:1])
        return np.asarray(held)


@dataclass(frozen=True)
class SensorOffset(Planted):
    """Torque sensors show so much too much, Nm."""

    effect: ClassVar[str] = "torque_offset"
    kind: ClassVar[str] = "offset"

    def read(self, channels: dict[str, FloatArray]) -> None:
        for joint in self.where:
            channels[f"effort.{joint}"] += self.amount
