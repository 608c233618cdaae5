"""Masses, centres of mass, inertias, and the direction of gravity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind, Scope
from sysid_btr.terms.effect import DofEffect, Effect, Probe
from sysid_btr.terms.scales import JointScale

if TYPE_CHECKING:
    import mujoco


def bodies(batch: BatchModel, places: tuple[str, ...]) -> list[int]:
    """Ids of bodies."""
    return [batch.model.body(name).id for name in places]


def allow_any_inertia(spec: mujoco.MjSpec, places: tuple[str, ...]) -> None:
    """Tell MuJoCo that these bodies' centres of mass will move: no short cuts for symmetric bodies."""
    for name in places:
        spec.body(name).simple = 0


@dataclass(frozen=True)
class Mass(Effect):
    """Mass of a body as a factor of the nominal; the inertia follows.

    Native: `body_mass` and `body_inertia`. Robots have it from their models' by a fifth: between those who weighed the
    parts (0.8 to 1.2: Tan et al. 2018, doi:10.15607/RSS.2018.XIV.010) and those who did not (0.5 to 1.5: Andrychowicz
    et al. 2020, doi:10.1177/0278364919887447).
    """

    name: ClassVar[str] = "mass"
    title: ClassVar[str] = "a change of the mass"
    usual: ClassVar[bool] = False
    signed: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("payload", "nothing, where the load sits at the body's centre of mass"),
    )
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.3, 3.0, 0.1, spread=0.2),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = bodies(batch, self.places)
        mass, inertia = batch.read("body_mass"), batch.read("body_inertia")
        mass[:, ids] *= values[:, :, 0]
        inertia[:, ids] *= values[:, :, :1]
        return {"body_mass": mass, "body_inertia": inertia}


@dataclass(frozen=True)
class Inertia(Effect):
    """Rotational inertia of a body about its centre of mass, as a factor; the mass stays.

    Native: `body_inertia`.
    """

    name: ClassVar[str] = "inertia"
    title: ClassVar[str] = "a change of the inertia"
    usual: ClassVar[bool] = False
    signed: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("armature", "motion of the body about several axes"),)
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.1, 10.0, 0.2),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        inertia = batch.read("body_inertia")
        inertia[:, bodies(batch, self.places)] *= values[:, :, :1]
        return {"body_inertia": inertia}


@dataclass(frozen=True)
class Armature(DofEffect):
    """Rotor inertia seen at the joint through the gear: ratio squared times the rotor's.

    Native: `dof_armature`.
    """

    name: ClassVar[str] = "armature"
    family: ClassVar[str] = "inertia"
    field: ClassVar[str] = "armature"
    compiled: ClassVar[str] = "dof_armature"
    title: ClassVar[str] = "rotor inertia"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("inertia", "kg m2", 0.0, 0.0, 1.0, 0.001),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("payload", "poses in which gravity pulls at the joint"),
        ("command_delay", "motion at several frequencies"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (Kind("inertia", "kg m2", 0.0, 0.0, 5 * scale.inertia, 0.05 * scale.inertia),)


@dataclass(frozen=True)
class ArmatureFactor(DofEffect):
    """Rotor inertia as a factor of what the model has.

    Native: `dof_armature`. Robots are taken to have it from their models' by three tenths, as the inertia of links is
    randomised, evenly from 0.5 to 1.5 (Tan et al. 2018, doi:10.15607/RSS.2018.XIV.010).
    """

    name: ClassVar[str] = "armature_factor"
    family: ClassVar[str] = "inertia"
    compiled: ClassVar[str] = "dof_armature"
    factor: ClassVar[bool] = True
    title: ClassVar[str] = "a change of the rotor inertia"
    usual: ClassVar[bool] = False
    signed: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("kp", "masses that are known: positions tell ratios of masses, gains and rotor inertia alone"),
    )
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.1, 10.0, 0.1, spread=0.3),)


ARM = 0.05
"""Distance, m, of a load whose mass a scan cannot distinguish from its place."""

LEVERS = (0.03, 0.2)
"""Distances, m, that a scan is believed."""


@dataclass(frozen=True)
class Payload(Effect):
    """A load that a body carries: a mass at a place in the body's frame, with an inertia of its own.

    Native: the body's mass, centre of mass and inertia are those of body and load together.

    The parameters are the mass and the position of the load in the frame of the body, whose origin is
    the joint it hangs on where the model follows the usual convention, and the inertia about its own centre, alike
    about all axes, as of a ball. A load taken for a point would pay for its size with its mass and place.
    """

    name: ClassVar[str] = "payload"
    family: ClassVar[str] = "payload"
    title: ClassVar[str] = "payload"
    scope: ClassVar = "body"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("mass", "kg", 0.0, 0.0, 2.0, 0.05),
        *(Kind(axis, "m", 0.0, -0.3, 0.3, 0.02) for axis in "xyz"),
        Kind("inertia", "kg m2", 0.0, 0.0, 0.01, 2e-5),
    )
    details: ClassVar[tuple[str, ...]] = ("inertia",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("mass", "nothing, where the load sits at the body's centre of mass"),
        ("com_offset", "a free base, or fast motion"),
        ("joint_spring", "the same joint angle in another orientation to gravity"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        m, d = 0.05, 0.05
        return (tuple((m, *place, 0.0) for place in ((0.0, 0.0, 0.0), (d, 0.0, 0.0), (0.0, d, 0.0), (0.0, 0.0, d))),)

    @classmethod
    def combine(cls, scale: JointScale, probe: Probe, amounts: FloatArray) -> FloatArray | None:
        """The probe's directions are equal loads at several places: amounts add, places average."""
        total = float(np.sum(amounts))
        moment = np.dot(amounts, [[d[0] * x for x in d[1:4]] for d in probe])
        size = float(np.linalg.norm(moment))
        lever = size / (total * probe[0][0]) if total > 0 else 0.0
        if not LEVERS[0] <= lever <= LEVERS[1]:
            # the mass is hardly identifiable: begin from one that has the moment at a hand's breadth
            if size == 0:
                return None
            mass = min(size / ARM, cls.kinds[0].upper)
            return np.array([mass, *(moment / mass), 0.0])
        kinds = cls.sized(scale)
        values = np.array([np.dot(amounts, [d[i] for d in probe]) / total for i in range(len(kinds))])
        values[0] *= total
        return np.array([np.clip(v, k.lower, k.upper) for v, k in zip(values, kinds, strict=True)])

    @property
    def begin(self) -> FloatArray:
        """A small load: where there is none, nothing responds to its place."""
        kinds = self.numbers * len(self.groups)
        return np.array(
            [p.scale if k.name == "mass" else p.nominal for k, p in zip(kinds, self.parameters, strict=True)]
        )

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        allow_any_inertia(spec, self.places)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        mass, inertia = batch.read("body_mass"), batch.read("body_inertia")
        ipos, iquat = batch.read("body_ipos"), batch.read("body_iquat")
        for place, name in enumerate(self.places):
            body = batch.model.body(name).id
            added, where, ball = values[:, place, 0], values[:, place, 1:4], values[:, place, 4]
            loaded = added > 0
            if not loaded.any():
                continue
            own, centre = mass[:, body].copy(), ipos[:, body].copy()
            total = own + added
            joint = (own[:, None] * centre + added[:, None] * where) / total[:, None]
            rotation = _matrices(iquat[:, body])
            tensor = np.einsum("mij,mj,mkj->mik", rotation, inertia[:, body], rotation)
            tensor = tensor + _point(own, centre - joint) + _point(added, where - joint)
            tensor = tensor + ball[:, None, None] * np.eye(3)
            principal, axes = np.linalg.eigh(tensor)
            axes[np.linalg.det(axes) < 0, :, 0] *= -1
            mass[loaded, body] = total[loaded]
            ipos[loaded, body] = joint[loaded]
            inertia[loaded, body] = principal[loaded]
            iquat[loaded, body] = _quaternions(axes[loaded])
        return {"body_mass": mass, "body_inertia": inertia, "body_ipos": ipos, "body_iquat": iquat}


def _point(mass: FloatArray, r: FloatArray) -> FloatArray:
    """Inertia (m, 3, 3) of point masses at r about the origin."""
    square = np.einsum("mi,mi->m", r, r)
    outer = np.einsum("mi,mj->mij", r, r)
    result: FloatArray = mass[:, None, None] * (square[:, None, None] * np.eye(3) - outer)
    return result


def _matrices(quaternions: FloatArray) -> FloatArray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternions, scalar_first=True).as_matrix())


def _quaternions(matrices: FloatArray) -> FloatArray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(matrices).as_quat(scalar_first=True))


@dataclass(frozen=True)
class ComOffset(Effect):
    """A body whose centre of mass is not where the model has it.

    Native: `body_ipos`.
    """

    name: ClassVar[str] = "com_offset"
    family: ClassVar[str] = "payload"
    also: ClassVar[tuple[str, ...]] = ("com",)
    title: ClassVar[str] = "shift of the centre of mass"
    scope: ClassVar = "body"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = tuple(Kind(axis, "m", 0.0, -0.06, 0.06, 0.005) for axis in "xyz")
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("payload", "a body on a free base, or fast motion"),
        ("encoder_offset", "several poses"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        d = 0.01
        return (((d, 0.0, 0.0), (0.0, d, 0.0), (0.0, 0.0, d)),)

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        allow_any_inertia(spec, self.places)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        centre = batch.read("body_ipos")
        centre[:, bodies(batch, self.places)] += values
        return {"body_ipos": centre}


@dataclass(frozen=True)
class GravityTilt(Effect):
    """A mount that is not level: gravity is tilted for the whole robot.

    Native: `opt.gravity`, turned by the angle `x` about the world's x axis, then `y` about its y axis.
    """

    name: ClassVar[str] = "gravity_tilt"
    family: ClassVar[str] = "mount"
    title: ClassVar[str] = "tilt of the mount"
    scope: ClassVar = "robot"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("x", "rad", 0.0, -0.3, 0.3, 0.01), Kind("y", "rad", 0.0, -0.3, 0.3, 0.01))
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("com_offset", "an IMU, or several limbs"),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.02, 0.0), (0.0, 0.02)),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        gravity = batch.read("opt.gravity")
        x, y = values[:, 0, 0], values[:, 0, 1]
        gx, gy, gz = gravity[:, 0].copy(), gravity[:, 1].copy(), gravity[:, 2].copy()
        gy, gz = np.cos(x) * gy - np.sin(x) * gz, np.sin(x) * gy + np.cos(x) * gz
        gravity[:, 0] = np.cos(y) * gx + np.sin(y) * gz
        gravity[:, 1] = gy
        gravity[:, 2] = -np.sin(y) * gx + np.cos(y) * gz
        return {"opt.gravity": gravity}
