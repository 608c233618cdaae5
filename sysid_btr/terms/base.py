"""Parametrised changes of a model: what `--fit` frees, and what `close` finds to be missing.

A `Term` owns a few parameters at a few places (joints, bodies, or the whole robot) and takes part in
a replay at the stages it needs, by overriding the hooks below. All hooks act on a batch of candidates at
once; ``values`` always has the shape (candidates, places, kinds).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.terms.drives import DriveKind
from sysid_btr.terms.law import Step
from sysid_btr.terms.scales import SLIDE_UNITS, JointScale, Scales, largest_scale

if TYPE_CHECKING:
    import mujoco

LINK_SUFFIX = "__link"
"""Name ending of what play or compliance adds on the link side of a joint: a second joint, a tendon."""
TETHER_SUFFIX, ANCHOR_SUFFIX = "__tether", "__anchor"
"""Endings of the names of a tether's tendon and site on a body, and of the site where it is fixed."""


GROWTH = 5.0
"""Factor by which a bound that nobody stated grows."""


@dataclass(frozen=True)
class Parameter:
    """One number that a candidate carries.

    Attributes
    ----------
    name : as in the parameter grammar, for example ``mass:RKneePitch``.
    unit : SI unit, ``1`` for scale factors.
    nominal : value at which the model is exactly the plain one.
    lower, upper : bounds of the search.
    scale : size of a change that matters (finite differences, starts, scans).
    stated : whether the bounds are the user's or the robot's, which do not grow.
    spread : standard deviation of what robots have from the nominal value; infinite where a model states nothing, or
        the user states bounds.
    """

    name: str
    unit: str
    nominal: float
    lower: float
    upper: float
    scale: float
    stated: bool = False
    spread: float = np.inf

    def near(self, value: float, reach: float) -> Parameter:
        """The same with bounds that are no further than `reach` from a value, and the nominal value within them."""
        low, high = max(value - reach, self.lower), min(value + reach, self.upper)
        return replace(self, nominal=min(max(self.nominal, low), high), lower=low, upper=high)

    def wider(self, side: float) -> Parameter:
        """The same with its upper (side 1) or lower (-1) bound grown, unless it is stated or set by physics."""
        # a ratio stays below one, whatever the data want
        if self.stated or (side > 0 and self.unit == "1" and self.upper <= 1):
            return self
        if side > 0:
            return replace(self, upper=GROWTH * self.upper)
        return replace(self, lower=GROWTH * self.lower if self.lower < 0 else self.lower / GROWTH)

    def holding(self, value: float) -> Parameter:
        """The same with bounds that have grown until a value that was found is within them."""
        side = float(value > self.upper) - float(value < self.lower)
        grown = self.wider(side) if side else self
        return self if grown == self else grown.holding(value)


@dataclass(frozen=True)
class Kind:
    """What a term's parameter is, before it is tied to a place."""

    name: str
    unit: str
    nominal: float
    lower: float
    upper: float
    scale: float
    spread: float = np.inf


def parameter_of(kind: Kind, name: str) -> Parameter:
    """A parameter of a kind, by name."""
    return Parameter(name, kind.unit, kind.nominal, kind.lower, kind.upper, kind.scale, spread=kind.spread)


@dataclass(frozen=True)
class JointAddresses:
    """Where the log's joints live in the compiled model.

    Attributes
    ----------
    joints : joint names in the order of the outputs, (nj,).
    qpos, dof, actuator, body : their addresses, (nj,); actuator is -1 for a joint without a drive.
    drive : (nj,) kind of drive, so of command; None for a joint without one.
    scale : (nj,) ctrl per command in units of the joint.
    controls : actuators that are commanded by their own name, in ctrl, and their numbers, (nc,).
    link_qpos, link_dof : addresses of a second, play or compliance joint on the link side, -1 where none.
    base : addresses in qpos and qvel of a free base that is to be recorded, None where it is not.
    """

    joints: tuple[str, ...]
    qpos: IntArray
    dof: IntArray
    actuator: IntArray
    body: IntArray
    link_qpos: IntArray
    link_dof: IntArray
    drive: tuple[DriveKind | None, ...]
    scale: FloatArray
    controls: tuple[str, ...]
    control: IntArray
    base: tuple[int, int] | None = None

    def of(self, names: Sequence[str]) -> IntArray:
        """Positions of joint names in the outputs."""
        lookup = {name: i for i, name in enumerate(self.joints)}
        return np.array([lookup[name] for name in names], dtype=np.int64)

    def driven_by(self, *kinds: DriveKind) -> BoolArray:
        """(nj,) whether the drive of a joint is of one of these kinds."""
        return np.array([kind in kinds for kind in self.drive], dtype=bool)


Fields = dict[str, FloatArray]
"""Compiled model field by name -> its values under each candidate, (candidates, ...)."""


@dataclass(frozen=True, eq=False)
class BatchModel:
    """The models of some candidates: one compiled model, and what each of them changes in it.

    Attributes
    ----------
    model : compiled, without what candidates change.
    index, timestep : addresses of joints, and s.
    size : number of candidates.
    fields : compiled fields that are no longer the model's.
    state : MjData fields with which a simulation begins, other than those of the joints of the log.
    """

    model: mujoco.MjModel
    index: JointAddresses
    timestep: float
    size: int
    fields: Fields = field(default_factory=dict)
    state: Fields = field(default_factory=dict)

    def read(self, name: str) -> Any:
        """A copy of a compiled field's present values (`opt.gravity` for one of the options), (candidates, ...)."""
        if name in self.fields:
            return self.fields[name].copy()
        shared = self.compiled(name)
        return np.tile(shared, (self.size, *(1,) * shared.ndim))

    def write(self, fields: Fields) -> None:
        """Let fields have these values."""
        for name, values in fields.items():
            shared = self.compiled(name)
            self.fields[name] = np.array(np.broadcast_to(values, (self.size, *shared.shape)), dtype=shared.dtype)

    def candidate(self, row: int) -> mujoco.MjModel:
        """A compiled model of one candidate's own, with what MuJoCo derives from its fields."""
        import mujoco

        own = copy.copy(self.model)
        for name, values in self.fields.items():
            if name.startswith("opt."):
                setattr(own.opt, name[4:], values[row])
            else:
                getattr(own, name)[...] = values[row]
        if self.derives:
            mujoco.mj_setConst(own, mujoco.MjData(own))
        return own

    @property
    def derives(self) -> bool:
        """Whether MuJoCo derives others from the changed fields."""
        import mujoco

        return not self.fields.keys().isdisjoint(mujoco.MjModel._setconst_inputs)

    def compiled(self, name: str) -> Any:
        """The compiled field itself, which all candidates have that do not change it."""
        return np.asarray(getattr(self.model.opt, name[4:]) if name.startswith("opt.") else getattr(self.model, name))


@dataclass
class Outputs:
    """Predicted sensors at the log's sample times; arrays are (candidates, samples, joints of the log).

    `base`, where it is recorded, is (candidates, samples, 13): position, quaternion, velocity, angular velocity of
    the free base as MuJoCo has them, at the step border before each sample. `began` is when `time` was 0, s on the
    clock of the log, of each candidate (m,) or of all.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray | None
    base: FloatArray | None = None
    began: FloatArray | float = 0.0


Scope = Literal["body", "joint", "drive", "feedback", "servo", "robot"]
"""Bodies with mass; joints: all, with a drive, with one that feeds position or velocity back, position; the whole."""


@dataclass(frozen=True)
class Term:
    """Base of everything that changes a model under parameters; hooks that do nothing by default.

    Attributes
    ----------
    places : joint or body names, or ``("robot",)``.
    shared : one set of parameters for all places instead of one each.
    known : the parameters with the nominal values and bounds of a robot, once these are known.
    declared : name under which the user freed it; empty for what was added.
    fixed : value of every kind, None where it is free; empty where all are.
    ranges : (places, 2) of the variable that its numbers are a function of; empty for most.
    """

    places: tuple[str, ...]
    shared: bool = False
    known: tuple[Parameter, ...] = ()
    declared: str = ""
    fixed: tuple[float | None, ...] = ()
    ranges: tuple[tuple[float, float], ...] = ()

    name: ClassVar[str] = ""
    label: ClassVar[str] = ""
    """In the names of its parameters, where the name alone would not distinguish it from another one beside it."""
    variant: ClassVar[str] = ""
    """Tells apart two realisations under one name; empty for most."""
    field: ClassVar[str] = ""
    """Name under which its first kind is the model's own value: `frictionloss`, to which `coulomb_friction` adds."""
    also: ClassVar[tuple[str, ...]] = ()
    """Other names under which it can be freed."""
    kinds: ClassVar[tuple[Kind, ...]] = ()
    scope: ClassVar[Scope] = "joint"
    """What its places are."""
    declared_at: ClassVar[Scope | None] = None
    """What its places are where it is declared, if not that."""
    structural: ClassVar[bool] = False
    """Whether it adds joints to the model, which then has to be compiled for its places."""
    rough: ClassVar[bool] = False
    """Whether what a replay leaves is rough in its numbers, as where teeth meet: derivatives are then taken by wide
    steps."""
    switches: ClassVar[bool] = False
    """Whether its law takes the torque of a drive away where the log's `enabled` is false."""
    law_acts: ClassVar[tuple[str, ...]] = ("servo", "friction", "limit")
    """What the law may change beside the joint torque: gain and motor torque, friction, limits."""
    law_memory: ClassVar[int] = 0
    """Numbers that the law keeps from step to step at each place; zero at the start."""

    @property
    def called(self) -> str:
        """Its name in results."""
        return self.declared or self.name

    @property
    def absolute(self) -> bool:
        """Whether its number takes the place of the model's own instead of changing it."""
        return self.declared == self.field != ""

    @property
    def location(self) -> Scope:
        """What its places are."""
        return self.declared_at if self.declared and self.declared_at else self.scope

    @property
    def numbers(self) -> tuple[Kind, ...]:
        """The kinds of its parameters at one place."""
        if self.absolute:
            return self.kinds[:1]
        return tuple(k for k, v in zip(self.kinds, self.fixed, strict=True) if v is None) if self.fixed else self.kinds

    @property
    def groups(self) -> tuple[str, ...]:
        """Label of each independent set of parameters."""
        return tuple(",".join(places) for places in self.grouped)

    @property
    def grouped(self) -> tuple[tuple[str, ...], ...]:
        """Places of each independent set of parameters."""
        if self.shared and len(self.places) > 1:
            return (self.places,)
        return tuple((place,) for place in self.places)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The free numbers, place by place, kind by kind within a place."""
        if self.known:
            return self.known
        name, several = self.declared or self.label or self.name, len(self.numbers) > 1 or bool(self.fixed)
        return tuple(
            parameter_of(kind, f"{name}.{kind.name}:{group}" if several else f"{name}:{group}")
            for group in self.groups
            for kind in self.numbers
        )

    @property
    def neutral(self) -> FloatArray:
        """(parameters,) values at which the model is exactly the plain one."""
        return np.array([p.nominal for p in self.parameters])

    @property
    def begin(self) -> FloatArray:
        """(parameters,) values at which a search begins that is told nothing else."""
        return self.neutral

    def spread(self, values: FloatArray) -> FloatArray:
        """Candidate numbers (m, parameters) as (m, places, kinds); one kind alone where that is `absolute`."""
        shaped = values.reshape(len(values), len(self.groups), len(self.numbers))
        if self.fixed:
            whole = np.tile(np.array(self.fixed, dtype=np.float64), (*shaped.shape[:2], 1))
            whole[np.isnan(whole)] = shaped.ravel()
            shaped = whole
        return np.broadcast_to(shaped, (len(values), len(self.places), shaped.shape[2]))

    def neutral_of(self, kind: int) -> FloatArray:
        """(places,) neutral value of one kind."""
        fixed = self.fixed[kind] if self.fixed else None
        if fixed is not None:
            return np.full(len(self.places), fixed)
        own = self.parameters[self.numbers.index(self.kinds[kind]) :: len(self.numbers)]
        return np.broadcast_to(np.array([p.nominal for p in own]), (len(self.places),))

    def changed(self, present: FloatArray, values: FloatArray) -> FloatArray:
        """The model's own values (m, places) under this term's numbers: those instead, or those added."""
        return values if self.absolute else present + values

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        """The kinds with nominal value, bounds and scale for one place; in the units of a hinge also at a slide."""
        return cls.kinds

    def in_units_of(self, kind: Kind, *, slide: bool) -> Kind:
        """A kind in the units of a slide or of a hinge; of a body they are the same."""
        return replace(kind, unit=SLIDE_UNITS.get(kind.unit, kind.unit)) if slide and self.scope != "body" else kind

    @classmethod
    def own_value(cls, model: mujoco.MjModel, place: str) -> float:
        """What the model has at a place of what `field` names; infinite for a limit that it has not."""
        raise NotImplementedError(f"{cls.__name__} names a field and does not say what a model has of it")

    @classmethod
    def absolute_kind(cls, kind: Kind, own: float) -> Kind:
        """The kind of the model's own value, given that of its change and what the model has."""
        upper = max(kind.upper, 10 * own) if np.isfinite(own) else kind.upper
        return replace(kind, nominal=min(own, upper), lower=min(kind.lower, own), upper=upper)

    @classmethod
    def at(cls, places: Sequence[str], scales: Scales, *, shared: bool = False) -> Self:
        """The term at some places of a robot whose sizes are known."""
        bare = cls(places=tuple(places), shared=shared and len(places) > 1)
        sizes = (largest_scale(scales, group) for group in bare.grouped)
        kinds = (bare.in_units_of(kind, slide=size.slide) for size in sizes for kind in cls.sized(size))
        known = tuple(parameter_of(kind, p.name) for kind, p in zip(kinds, bare.parameters, strict=True))
        return replace(bare, known=known).over(scales)

    def over(self, scales: Scales) -> Self:
        """The same over the ranges that what it is a function of has at its places."""
        return self

    def in_words(self, place: str, values: FloatArray) -> str:
        """What its numbers (kinds,) at a place amount to, where they say nothing one by one; else empty."""
        return ""

    # --- hooks, in the order in which a replay calls them -------------------------------------------------

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add structure before the model is compiled (once, never per candidate)."""

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        """Compiled fields that differ from the present ones, each whole: {name: (m, ...)}."""
        return {}

    def initial_state(self, batch: BatchModel, values: FloatArray, qpos: FloatArray, qvel: FloatArray) -> None:
        """Change the starting state in place; qpos and qvel are (m, joints of the log)."""

    @property
    def longest_delay(self) -> float:
        """Time (s) after which a command may still act; the longest of its times, if it transforms commands at all."""
        if not type(self).overrides("shape_command"):
            return 0.0
        return max((p.upper for p in self.parameters if p.unit == "s"), default=0.0)

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray, time: FloatArray) -> FloatArray:
        """Transform the commands that reach the servos, (m, steps, joints of the log).

        `time` (m or 1, steps + 1) is that of the borders of the steps, s since the first sample of the log.
        """
        return command

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray | None:
        """Joint torque known in advance, (m, steps, joints of the log), or None.

        `time` (m or 1, steps + 1) is that of the borders of the steps, s since the first sample of the log.
        """
        return None

    def law_numbers(self, values: FloatArray) -> FloatArray:
        """What the law needs of values (m, places, kinds) and places: (m, places, n)."""
        return values

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        """Act at every step, see `terms.law`; `places` are positions among the joints of the log."""

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        """Change what the sensors show, in place."""

    @classmethod
    def overrides(cls, hook: str) -> bool:
        """Whether this term takes part in a stage."""
        return getattr(cls, hook) is not getattr(Term, hook)
