"""What an effect is: a term that is neutral by default, sized by the robot, and scanned for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Term
from sysid_btr.terms.scales import JointScale

if TYPE_CHECKING:
    import mujoco

GUESSES = (0.3, 0.55, 1.0, 1.8, 3.0, 5.0)
"""Multiples of the scan's amount at which a refit may begin."""

THRESHOLDS = (0.6, 0.72, 0.85, 1.0, 1.15, 1.3, 1.5)
"""The same for a limit, which does nothing a little too high."""

GROUND = "a free base on the ground"
"""What an effect `needs` that a robot on a fixed base cannot show."""
HELD_BASE = "a base that does not move"
"""... that a robot on a free base cannot: where it is in the world is not measured."""
COMMANDS = "commands that are replayed"
"""What an effect `needs` whose variable would else be the torque that it is to explain."""

Probe = tuple[tuple[float, ...], ...]
"""Values (one tuple a direction) whose responses span an effect linearly at one working point."""


@dataclass(frozen=True)
class Effect(Term):
    """A physical effect that a model may lack.

    Class attributes
    ----------------
    name : as in results and on the command line.
    family : what physical cause it is a form of (``friction``, ``delay``, ...); empty if it is one of its own.
    title : in a sentence, after an amount: "0.33 Nm of dry friction".
    usual : whether it is looked for where the user names no effects.
    scope : which names it can sit at.
    confounders : effects that leave similar traces, and what separates them.
    needs : sensors without which it cannot be seen.
    signed : whether its amounts may have either sign.
    main : kind whose value says how large the effect is.
    steps : amounts the scan tries, in units of the kind's scale; more than one where the response bends.
    everywhere : whether it may well be alike at all places, so that the scan asks for that too.
    transient : whether it happens at some moment, so that held-out data may hold nothing of it.
    includes : simpler effects that are special cases of this one.
    yields_to : effects that are named instead of this one where they are confounded on a log.
    held : kinds that a scan takes from the probe as they are, because the response is not linear in them.
    details : kinds that such an effect never goes without, so that having them makes it no less simple.
    """

    title: ClassVar[str] = ""
    family: ClassVar[str] = ""
    usual: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = ()
    needs: ClassVar[str] = "position"
    signed: ClassVar[bool] = False
    main: ClassVar[int] = 0
    held: ClassVar[tuple[str, ...]] = ()
    details: ClassVar[tuple[str, ...]] = ()
    steps: ClassVar[tuple[float, ...]] = (2.0,)
    everywhere: ClassVar[bool] = False
    transient: ClassVar[bool] = False
    includes: ClassVar[tuple[str, ...]] = ()
    yields_to: ClassVar[tuple[str, ...]] = ()

    @property
    def described(self) -> str:
        """Its title; what is a torque at a hinge is a force at a slide."""
        return self.title.replace("torque", "force") if self.slides else self.title

    @property
    def slides(self) -> bool:
        """Whether its places are slides, whose units are others."""
        return bool(self.parameters) and self.parameters[0].unit != self.numbers[0].unit

    @classmethod
    def combine(cls, scale: JointScale, probe: Probe, amounts: FloatArray) -> FloatArray | None:
        """Values (kinds,) of an effect whose response is that of the probe's directions times `amounts`.

        None where no legal value does that.
        """
        values = []
        for i, kind in enumerate(cls.sized(scale)):
            if kind.name in cls.held:
                values.append(probe[0][i])
            else:
                changes = (direction[i] - kind.nominal for direction in probe)
                values.append(kind.nominal + sum(a * c for a, c in zip(amounts, changes, strict=True)))
            values[-1] = float(np.clip(values[-1], kind.lower, kind.upper))
        return np.array(values)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        """Alternative working points of the scan at one place; each spans the effect linearly."""
        kinds = cls.sized(scale)
        return tuple(
            (tuple(k.nominal + step * k.scale if i == cls.main else k.nominal for i, k in enumerate(kinds)),)
            for step in cls.steps
        )

    def around(self, values: FloatArray) -> Effect:
        """The effect with bounds between which a search from these values makes sense: wide enough to hold them."""
        known = tuple(p.holding(float(v)) for p, v in zip(self.parameters, values, strict=True))
        return self if known == self.parameters else replace(self, known=known)

    @classmethod
    def is_threshold(cls) -> bool:
        """Whether it does nothing, to any order, up to some value of its main kind: a limit that is not reached."""
        return cls.kinds[cls.main].name in cls.held

    @classmethod
    def initial_guesses(cls, values: FloatArray) -> FloatArray:
        """Amounts (k, kinds) that a refit may begin from, given what a linear scan says (kinds,).

        The response of friction, play, limits and delays bends: the scan's amount can be far off.
        """
        if cls.signed:
            return values[None]
        threshold = cls.is_threshold()
        rungs = np.array(THRESHOLDS if threshold else GUESSES)
        anchor = 0.0 if threshold else cls.kinds[cls.main].nominal
        result = np.tile(values, (len(rungs), 1))
        result[:, cls.main] = anchor + rungs * (values[cls.main] - anchor)
        return result


def family_of(effect: type[Effect]) -> str:
    """The family of causes that an effect is a form of; one that says none is one of its own."""
    return effect.family or effect.name


@dataclass(frozen=True)
class DofEffect(Effect):
    """An effect that is a compiled field of a joint's degree of freedom; of several numbers the first.

    Class attributes
    ----------------
    compiled : name of the field.
    factor : whether its number multiplies the model's own value instead of being added to it.
    """

    compiled: ClassVar[str] = ""
    factor: ClassVar[bool] = False

    def changed(self, present: FloatArray, values: FloatArray) -> FloatArray:
        return present * values if self.factor else super().changed(present, values)

    @classmethod
    def own_value(cls, model: mujoco.MjModel, place: str) -> float:
        dof = model.jnt_dofadr[model.joint(place).id]
        return float(np.ravel(getattr(model, cls.compiled)[dof])[0])

    def held_in(self, model: mujoco.MjModel, place: str) -> tuple[str, int]:
        """The compiled field that has the number of a place, and its row."""
        return self.compiled, int(model.jnt_dofadr[model.joint(place).id])

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        fields: Fields = {}
        for place, name in enumerate(self.places):
            compiled, row = self.held_in(batch.model, name)
            field = fields[compiled] if compiled in fields else batch.read(compiled)
            at = (slice(None), row, 0)[: field.ndim]
            field[at] = self.changed(field[at], values[:, place, 0])
            fields[compiled] = field
        return fields
