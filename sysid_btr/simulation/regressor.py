"""The torque of rigid bodies on a motion, linear in their inertial parameters.

Ten numbers a body: mass, mass times centre of mass, and the six of the inertia about the origin of the body's frame
(Atkeson, An, Hollerbach 1986, doi:10.1177/027836498600500306). What a unit of each takes is asked of MuJoCo once, body
by body as candidates change them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel, Fields

if TYPE_CHECKING:
    import mujoco

INERTIAL = ("body_mass", "body_ipos", "body_iquat", "body_inertia")
"""Fields that inertial parameters are made of."""
SIMPLE = 5
"""Of the probes, at the origin and about the axes of the body's frame."""


def inertial_parameters(mass: FloatArray, centre: FloatArray, axes: FloatArray, inertia: FloatArray) -> FloatArray:
    """Inertial parameters (..., 10) of bodies.

    Parameters
    ----------
    mass, centre : (...,) kg, and (..., 3) m in the frame of the body.
    axes, inertia : (..., 4) quaternion of the principal axes and (..., 3) kg m2 about them, as MuJoCo has them.
    """
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_quat(axes.reshape(-1, 4), scalar_first=True).as_matrix().reshape(*mass.shape, 3, 3)
    moment = mass[..., None] * centre
    tensor = (turned * inertia[..., None, :]) @ np.swapaxes(turned, -1, -2)
    tensor = tensor + np.sum(moment * centre, axis=-1)[..., None, None] * np.eye(3)
    tensor = tensor - moment[..., :, None] * centre[..., None, :]
    row, column = np.triu_indices(3)
    return np.concatenate([mass[..., None], moment, tensor[..., row, column]], axis=-1)


def inertial_changes(batch: BatchModel) -> FloatArray:
    """(m, bodies, 10) inertial parameters of candidates, less those of the model."""
    changes = np.zeros((batch.size, batch.model.nbody, 10))
    if batch.fields.keys().isdisjoint(INERTIAL):
        return changes
    own, values = [batch.compiled(name) for name in INERTIAL], [batch.read(name) for name in INERTIAL]
    # zero where nothing was changed, which a difference of rounded numbers need not be
    other = np.logical_or.reduce(
        [(v != o).reshape(*changes.shape[:2], -1).any(axis=2) for v, o in zip(values, own, strict=True)]
    )
    changes[other] = (inertial_parameters(*values) - inertial_parameters(*own))[other]
    return changes


def _probes() -> Fields:
    """Bodies (11,): of 1 kg at the origin; of 2 kg; with inertia about an axis; about one between two; off the origin.

    Nothing but linear algebra is asked of them, so they need not be bodies that there can be; MuJoCo wants them to have
    mass.
    """
    unit, half = np.eye(3), np.pi / 8
    straight, turned = (1.0, 0.0, 0.0, 0.0), [(np.cos(half), *np.sin(half) * unit[k]) for k in (1, 2, 0)]
    return {
        "body_mass": np.array([1.0, 2.0, *[1.0] * 9]),
        "body_ipos": np.concatenate([np.zeros((8, 3)), unit]),
        "body_iquat": np.array([*[straight] * 5, *turned, *[straight] * 3]),
        "body_inertia": np.concatenate([np.zeros((2, 3)), unit, unit, np.zeros((3, 3))]),
    }


class Columns(NamedTuple):
    """What joints (k,) that move a body take per unit of its parameters, (10, n, k)."""

    joints: list[int]
    torque: FloatArray


@dataclass(frozen=True, eq=False)
class Regressor:
    """What a motion takes of the bodies of a model, per unit of their inertial parameters.

    Attributes
    ----------
    model : whose bodies they are.
    bodies : (j,) body that each joint moves.
    samples : n of the motion.
    load : torques (m, n, j) that the motion takes of the model with other values (m, bodies, ...) of inertial fields.
    """

    model: mujoco.MjModel
    bodies: IntArray
    samples: int
    load: Callable[[Fields], FloatArray]
    _found: dict[int, Columns] = field(default_factory=dict)

    def torque(self, change: FloatArray) -> FloatArray:
        """Torques (n, j) that a change (bodies, 10) of the inertial parameters adds."""
        total = np.zeros((self.samples, len(self.bodies)))
        for body in np.flatnonzero(change.any(axis=1)):
            joints, columns = self.of(int(body))
            total[:, joints] += (change[body] @ columns.reshape(10, -1)).reshape(columns.shape[1:])
        return total

    def of(self, body: int) -> Columns:
        """What one body takes."""
        if body not in self._found:
            self._found[body] = self._measured(body)
        return self._found[body]

    def _measured(self, body: int) -> Columns:
        moving, at = set(), body
        while at:
            moving.add(at)
            at = int(self.model.body_parentid[at])
        joints = [j for j, own in enumerate(self.bodies) if own in moving]
        if not joints:
            return Columns(joints, np.zeros((10, self.samples, 0)))
        # a body that is compiled as simple stays at the origin and along the axes of its frame
        probes = {
            name: values[: SIMPLE if self.model.body_simple[body] else None] for name, values in _probes().items()
        }
        fields: Fields = {}
        for name, values in probes.items():
            own = getattr(self.model, name)
            fields[name] = np.tile(own, (len(values), *(1,) * own.ndim))
            fields[name][:, body] = values
        load = self.load(fields)[:, :, joints]
        parameters = inertial_parameters(*probes.values())
        basis = np.linalg.pinv(parameters[1:] - parameters[0])
        return Columns(joints, np.tensordot(basis, load[1:] - load[0], axes=1))
