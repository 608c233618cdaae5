"""What is rolled out: candidates of a model, their initial states, and what acts on them, as values of no engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.base import BatchModel, Fields, JointAddresses, Term

if TYPE_CHECKING:
    import mujoco

Values = Sequence[tuple[Term, FloatArray]]
"""Terms with their values, (m, places, kinds)."""


class Law(NamedTuple):
    """A term that acts at every step: its values (m, places, kinds), and its places among the joints."""

    term: Term
    values: FloatArray
    places: IntArray


@dataclass(frozen=True, eq=False)
class Setup:
    """All that a simulator needs to know of some candidates.

    Attributes
    ----------
    batch : compiled model, addresses of the joints, step, and the fields in which the candidates differ.
    state : MjData field -> (m, ...) at the start; what is not named is as `mj_resetData` leaves it, and only the
        state moves: forces in it (`xfrc_applied`) act all the time.
    command : (m, steps, j) as they reach the drives, in units of the joints, held over each step; see `ctrl`.
    control : (m, steps, nc) of actuators that are commanded by their own name, in ctrl, or None.
    applied : (m, steps, j) torques at the joints known in advance, Nm or N.
    laws : terms that act at every step, in the order in which they do.
    inputs : measured inputs of the drives, (steps, m) each, for laws.
    began : (m,) or of all, s on the clock of the log at the first step, for laws.
    held_steps : steps for which servos hold a torque; 0 where they act continuously.
    effort : whether the torques of the servos are asked for.
    """

    batch: BatchModel
    state: Fields
    command: FloatArray
    applied: FloatArray | None = None
    laws: tuple[Law, ...] = ()
    inputs: dict[str, FloatArray] = field(default_factory=dict)
    began: FloatArray | float = 0.0
    held_steps: int = 0
    effort: bool = False
    control: FloatArray | None = None

    @property
    def model(self) -> mujoco.MjModel:
        return self.batch.model

    @property
    def index(self) -> JointAddresses:
        return self.batch.index

    @property
    def size(self) -> int:
        """Number of candidates."""
        return self.batch.size

    @property
    def steps(self) -> int:
        return int(self.command.shape[1])

    @property
    def acts(self) -> frozenset[str]:
        """What laws change beside the torques at joints, see `Term.law_acts`."""
        return frozenset(name for law in self.laws for name in law.term.law_acts)

    def ctrl(self, steps: slice) -> FloatArray:
        """(m, k, nu) MuJoCo's ctrl in some of the steps."""
        index, command = self.index, self.command[:, steps]
        found = np.zeros((*command.shape[:2], self.model.nu))
        driven = np.flatnonzero(index.actuator >= 0)
        found[:, :, index.actuator[driven]] = as_ctrl(index, driven, command[:, :, driven])
        if self.control is not None:
            found[:, :, index.control] = self.control[:, steps]
        return found


def as_ctrl(index: JointAddresses, joints: IntArray | slice, command: FloatArray) -> FloatArray:
    """MuJoCo's ctrl for commands (..., k) of some joints, by their positions (k,) among all."""
    scale = index.scale[joints]
    return command if np.all(scale == 1) else command * scale


def write_terms(batch: BatchModel, pairs: Values) -> BatchModel:
    """Write the model fields of every candidate."""
    for term, values in pairs:
        batch.write(term.model_fields(batch, values))
    return batch


def prepare(
    batch: BatchModel,
    pairs: Values,
    qpos: FloatArray,
    qvel: FloatArray,
    command: FloatArray,
    numerics: Numerics,
    *,
    inputs: Callable[[], dict[str, FloatArray]] = dict,
    effort: bool = False,
    began: FloatArray | float = 0.0,
    lead: int = 0,
    extra: FloatArray | None = None,
) -> Setup:
    """What terms make of initial states, commands and torques, once their fields are written.

    Parameters
    ----------
    batch, pairs : the candidates, and the terms they differ in.
    qpos, qvel : (m, j) initial state of the joints of the log; terms may change it in place.
    command : (m, lead + steps, j) as logged.
    numerics : with which the model was compiled.
    inputs : gives the measured inputs of the drives, (steps, m) each, where a law asks for them.
    effort : whether the torques of the servos are asked for.
    began : s on the clock of the log before the first step, of each candidate (m,) or of all, for torques known in
        advance and laws.
    lead : commands from before the first step, that reach into it when they are delayed.
    extra : (m, lead + steps, ...) what else was commanded, as `Grid.extra` has it.
    """
    controls = len(batch.index.controls)
    if extra is not None and extra.shape[-1] > controls:
        command = command + fed_forward(batch, *np.split(extra[..., controls:], 2, axis=-1))
    applied: FloatArray | None = None
    steps = np.arange(-lead, command.shape[1] - lead + 1, dtype=np.float64)
    time = np.atleast_1d(began)[:, None] + batch.timestep * steps
    for term, values in pairs:
        term.initial_state(batch, values, qpos, qvel)
        command = term.shape_command(batch, values, command, time)
        torque = term.applied_torque(batch, values, time[:, lead:])
        if torque is not None:
            applied = torque if applied is None else applied + torque
    command = lagged(batch, command)
    laws = laws_of(batch.index, pairs)
    state = {name: np.zeros((batch.size, size)) for name, size in (("qpos", batch.model.nq), ("qvel", batch.model.nv))}
    state["qpos"][:] = batch.model.qpos0
    state["qpos"][:, batch.index.qpos], state["qvel"][:, batch.index.dof] = qpos, qvel
    control = extra[:, lead:, :controls] if extra is not None and controls else None
    if control is not None and batch.model.na:
        state["act"] = _at_rest(batch, control[:, 0])
    return Setup(
        batch,
        {**state, **batch.state},
        command[:, lead:],
        applied,
        laws,
        inputs() if laws else {},
        np.asarray(began, dtype=np.float64),
        numerics.held_steps,
        effort,
        control,
    )


def _at_rest(batch: BatchModel, control: FloatArray) -> FloatArray:
    """Activations (m, na) of filters that have come to rest at the first ctrl (m, nc); zero of anything else."""
    from mujoco import mjtDyn

    model, filters = batch.model, (int(mjtDyn.mjDYN_FILTER), int(mjtDyn.mjDYN_FILTEREXACT))
    activation = np.zeros((batch.size, model.na))
    for k, a in enumerate(batch.index.control):
        if int(model.actuator_dyntype[a]) in filters:
            activation[:, model.actuator_actadr[a]] = control[:, k]
    return activation


def laws_of(index: JointAddresses, pairs: Values) -> tuple[Law, ...]:
    """Terms that act at every step, in the order in which they do."""
    laws = [Law(term, values, _places(index, term)) for term, values in pairs if type(term).overrides("law")]
    # what a servo does comes before what depends on it
    return tuple(sorted(laws, key=lambda law: law.term.law_acts == ("friction",)))


def lagged(batch: BatchModel, command: FloatArray) -> FloatArray:
    """Commands (m, steps, j) behind the first-order filters of their drives, which begin at rest at the first one.

    Exact for held commands: the mean over each step of u + (y - u) exp(-t / T), where y is the filter's output at its
    beginning.
    """
    driven = np.flatnonzero(batch.index.actuator >= 0)
    constant = batch.read("actuator_dynprm")[:, batch.index.actuator[driven], 0]
    if not np.any(constant > 0):
        return command
    from scipy.signal import lfilter

    shaped = np.array(np.broadcast_to(command, (batch.size, *command.shape[1:])))
    for drive, joint in enumerate(driven):
        for own in np.unique(constant[constant[:, drive] > 0, drive]):
            rows = np.flatnonzero(constant[:, drive] == own)
            ratio = batch.timestep / own
            gone, u = -np.expm1(-ratio), shaped[rows, :, joint]
            y, _ = lfilter([0.0, gone], [1.0, gone - 1], u, zi=u[:, :1])
            shaped[rows, :, joint] = u + (y - u) * gone / ratio
    return shaped


def fed_forward(batch: BatchModel, velocity: FloatArray, torque: FloatArray) -> FloatArray:
    """Change of the commands that acts as wanted velocities and torques beside them do, all (m, steps, j).

    A drive with torque = kp (q* - q) + kd (v* - v) + tau* obeys q* + (kd v* + tau*) / kp.
    """
    index, driven = batch.index, np.flatnonzero(batch.index.actuator >= 0)
    actuators = index.actuator[driven]
    names = ("gear", "gainprm", "biasprm")
    gear, gain, bias = (batch.read(f"actuator_{name}")[:, None, actuators] for name in names)
    servo = index.driven_by("position")[driven]
    force = torque[..., driven] / gear[..., 0]
    force -= np.where(servo, bias[..., 2] * gear[..., 0] * velocity[..., driven], 0.0)
    slope = gain[..., 0] * index.scale[driven]
    change = np.zeros(torque.shape)
    change[..., driven] = np.divide(force, slope, out=np.zeros_like(force), where=slope != 0)
    return change


def _places(index: JointAddresses, term: Term) -> IntArray:
    """Positions of a term's places among the joints; every joint for the whole robot."""
    known = set(index.joints)
    if all(place in known for place in term.places):
        return index.of(term.places)
    return np.arange(len(index.joints))
