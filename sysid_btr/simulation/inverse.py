"""Inverse dynamics: which torque did the measured motion take? No integration, so nothing diverges.

torque = M(q) a + bias(q, v) - passive(q, v) + friction sign(v) - what acts on the joints otherwise,

with q, v, a of the log. Terms take part as in a replay, but for those that need a command, a memory or another sensor:
these move nothing here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from hashlib import sha256
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.simulation.joint_torques import own_torques, without_own
from sysid_btr.simulation.kinematics import Kinematics
from sysid_btr.simulation.mujoco_batch import VELOCITY, evaluate
from sysid_btr.simulation.regressor import INERTIAL, Regressor, inertial_changes
from sysid_btr.simulation.replay import Replay
from sysid_btr.simulation.setup import Law, Values, laws_of, write_terms
from sysid_btr.terms.base import BatchModel, Fields, Outputs, Term

if TYPE_CHECKING:
    import mujoco

NOT_RIGID = ("dof_frictionloss", "tendon_frictionloss", *(f"actuator_{n}" for n in ("gain", "bias", "dyn", "force")))
"""Beginnings of fields that the torque of the rigid bodies does not depend on."""
BETWEEN = ("dof_", "jnt_stiffness", "qpos_spring", "tendon_")
"""Beginnings of fields that it depends on, and that part of it which masses make does not."""
ROUNDS = 8
"""In which friction that follows the servo's torque is found, at most: one that goes with it takes three."""


class Rigid(NamedTuple):
    """Torques (n, j) of the rigid bodies and of what is between them, and those of weight and motion alone."""

    torque: FloatArray
    load: FloatArray


@dataclass(frozen=True)
class InverseReplay(Replay):
    """The torques that a measured motion takes under candidates.

    Attributes
    ----------
    kinematics : motion of the joints in the order of `index.joints`, sample by sample of the log.
    """

    kinematics: Kinematics | None = None

    @property
    def motion(self) -> Kinematics:
        """The kinematics that there must be."""
        if self.kinematics is None:
            raise ValueError("inverse dynamics need a motion")
        return self.kinematics

    def batch(self, pairs: Values, size: int) -> BatchModel:
        """The models of some candidates; a step is a sample of the motion."""
        return write_terms(BatchModel(self.model, self.index, self.motion.period, size), pairs)

    def _run(self, candidates: FloatArray) -> Outputs:
        pairs, m, motion = self._values(candidates), len(candidates), self.motion
        batch = self.batch(pairs, m)
        shape = (m, *motion.position.shape)
        effort = np.empty(shape)
        friction, applied = batch.read("dof_frictionloss")[:, self.index.dof], self._applied(batch, pairs)
        laws = tuple(law for law in laws_of(self.index, pairs) if not needs_history(type(law.term)))
        acting = _acting(laws, motion, m)
        parts = zip(self._rigid(without_own(batch)), own_torques(batch, motion), acting, strict=True)
        for i, (rigid, own, act) in enumerate(parts):
            smooth = rigid.torque + own.rotors + own.others
            effort[i] = smooth + friction[i] * motion.direction
            if act is not None:
                act(friction[i], smooth, rigid.load + own.rotors, effort[i])
        outputs = Outputs(
            motion.time,
            np.array(np.broadcast_to(motion.position, shape)),
            np.array(np.broadcast_to(motion.velocity, shape)),
            motion.low_passed(effort - applied),
        )
        for term, values in pairs:
            term.read_out(batch, values, outputs)
        return outputs

    @cached_property
    def _digest(self) -> bytes:
        """Of the compiled model."""
        import mujoco

        content = np.empty(mujoco.mj_sizeModel(self.model), dtype=np.uint8)
        mujoco.mj_saveModel(self.model, None, content)
        return sha256(content.tobytes()).digest()

    @cached_property
    def _bodies(self) -> bytes:
        """Digest of what the model has of bodies and joints, and of what pulls at them."""
        model, option = self.model, self.model.opt
        names = [name for name in dir(model) if name.startswith(("body_", "jnt_", "dof_")) or name == "qpos0"]
        values = [self.index.dof, option.gravity, option.disableflags, *(getattr(model, name) for name in names)]
        return sha256(b"".join(np.asarray(x).tobytes() for x in values)).digest()

    @cached_property
    def _linear(self) -> bool:
        """Whether masses act by inertia and weight alone: compensation of gravity and fluids follow them too."""
        model = self.model
        return not (model.body_gravcomp.any() or model.opt.density or model.opt.viscosity)

    def _rigid(self, batch: BatchModel) -> Iterator[Rigid]:
        """What bodies take in each candidate, and what is between them that is no joint's own.

        Candidates that differ in nothing of that share one computation, and the last ones are remembered. Those whose
        bodies hang together as the model's do are that model, and what the regressor says of their masses.
        """
        fields = {name: values for name, values in batch.fields.items() if not name.startswith(NOT_RIGID)}
        massless = {name: values for name, values in fields.items() if name not in INERTIAL}
        alike = np.full(batch.size, self._linear)
        for name, values in massless.items():
            if not name.startswith(BETWEEN):
                alike &= (values == batch.compiled(name)).reshape(batch.size, -1).all(axis=1)
        changes = inertial_changes(batch)
        for i in range(batch.size):
            rigid = self._remembered(replace(batch, fields=massless if alike[i] else fields), i)
            if alike[i] and changes[i].any():
                work = partial(self._regressor.torque, changes[i])
                moved = self.motion.remember((self._bodies, changes[i].tobytes()), work)
                rigid = Rigid(rigid.torque + moved, rigid.load + moved)
            yield rigid

    def _remembered(self, batch: BatchModel, candidate: int) -> Rigid:
        own = tuple((name, batch.fields[name][candidate].tobytes()) for name in sorted(batch.fields))
        return self.motion.remember((self._digest, own), lambda: self._of_one(batch.candidate(candidate)))

    @property
    def _regressor(self) -> Regressor:
        """Of the motion; models whose bodies are the same have it in common."""
        make = partial(Regressor, self.model, self.index.body, len(self.motion.time), self._loads)
        return self.motion.remember(("regressor", self._bodies), make)

    def _loads(self, inertial: Fields) -> FloatArray:
        """Torques (m, n, j) of weight and motion of the model with other inertial fields (m, ...)."""
        size = len(inertial["body_mass"])
        batch = without_own(BatchModel(self.model, self.index, self.motion.period, size, inertial))
        # some rotor inertia, the same in all: an inertia matrix is to be inverted whatever the bodies are
        batch.write({"dof_armature": np.ones(self.model.nv)})
        return np.stack([self._of_one(batch.candidate(i)).load for i in range(batch.size)])

    def _of_one(self, model: mujoco.MjModel) -> Rigid:
        motion, dof = self.motion, self.index.dof
        own = BatchModel(model, self.index, motion.period, len(motion.time))
        qpos = np.tile(model.qpos0, (own.size, 1))
        qvel, acceleration = np.zeros((own.size, model.nv)), np.zeros((own.size, model.nv))
        qpos[:, self.index.qpos], qvel[:, dof] = motion.position, motion.velocity
        acceleration[:, dof] = motion.acceleration
        names = ("M", "qfrc_bias", "qfrc_passive")
        seen = evaluate(own, {"qpos": qpos, "qvel": qvel}, names, stage=VELOCITY, threads=self.threads)
        weight = _times(model, seen["M"], acceleration) + seen["qfrc_bias"]
        return Rigid((weight - seen["qfrc_passive"])[:, dof], weight[:, dof])

    def _applied(self, batch: BatchModel, pairs: Values) -> FloatArray:
        """Torques (m, n, j) known in advance."""
        motion = self.motion
        borders = np.append(motion.time, motion.time[-1] + motion.period)[None] - 0.5 * motion.period
        applied = np.zeros((1, 1, 1))
        for term, values in pairs:
            torque = term.applied_torque(batch, values, borders)
            if torque is not None:
                applied = applied + torque
        return applied


Acting = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], None]
"""Takes friction (j,) without laws, torques (n, j) without any and those of the load; changes those of the drives."""


def _acting(laws: tuple[Law, ...], motion: Kinematics, candidates: int) -> list[Acting | None]:
    """What laws do on the samples of a motion, candidate by candidate; None where they do nothing."""
    if not laws:
        return [None] * candidates
    # imports what compiles laws, which takes a second
    from sysid_btr.simulation.laws import numbers_of_many, side_by_side, table_of
    from sysid_btr.simulation.stepping import Samples, on_samples

    table, numbers, awake = table_of(laws, candidates)
    n, joints = motion.position.shape
    # laws of a place each take all samples at once; where one joins drives, all go sample by sample
    together = 1 if any(law.term.scope == "robot" for law in laws) else n
    many = side_by_side(table, joints, together)

    def wide(values: FloatArray) -> FloatArray:
        return np.ascontiguousarray(values).reshape(-1, together * joints)

    position, velocity, direction = (wide(x) for x in (motion.position, motion.velocity, motion.direction))

    def act(candidate: int, dry: FloatArray, smooth: FloatArray, load: FloatArray, torque: FloatArray) -> None:
        # friction may follow the torque of the servo: the predicted one, as the measured would explain itself
        samples = Samples(position, velocity, direction, wide(smooth), wide(load))
        own, found = numbers_of_many(table, numbers[candidate], together), wide(torque)
        on_samples(many, own, awake[candidate], motion.period, ROUNDS, samples, np.tile(dry, together), found)
        torque[:] = found.reshape(torque.shape)

    return [partial(act, i) if awake[i].any() else None for i in range(candidates)]


def needs_history(term: type[Term]) -> bool:
    """Whether a kind of term acts by what was before, or through a joint of its own, and so not on single samples."""
    return term.law_memory > 0 or term.structural


def _times(model: mujoco.MjModel, inertia: FloatArray, acceleration: FloatArray) -> FloatArray:
    """Inertia matrices (n, nC), of which MuJoCo keeps the lower triangle by rows, times accelerations (n, nv)."""
    row = np.repeat(np.arange(model.nv), model.M_rownnz)
    column = np.array(model.M_colind)
    result = np.zeros(acceleration.shape)
    for k, (i, j) in enumerate(zip(row, column, strict=True)):
        result[:, i] += inertia[:, k] * acceleration[:, j]
        if i != j:
            result[:, j] += inertia[:, k] * acceleration[:, i]
    return result
