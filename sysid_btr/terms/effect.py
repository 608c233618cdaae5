"""What an effect is: a term that is neutral by default, sized by the robot, and scanned for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import Kind, Parameter, Term
from sysid_btr.terms.scales import JointScale, Scales

LADDER = (0.3, 0.55, 1.0, 1.8, 3.0, 5.0)
"""Multiples of the scan's amount at which a refit may begin."""

THRESHOLDS = (0.6, 0.72, 0.85, 1.0, 1.15, 1.3, 1.5)
"""The same for a limit, which does nothing a little too high."""

Probe = tuple[tuple[float, ...], ...]
"""Values (one tuple a direction) whose responses span an effect linearly at one working point."""


@dataclass(frozen=True)
class Effect(Term):
    """A physical effect that a model may lack.

    Class attributes
    ----------------
    name : as in results and on the command line.
    title : in a sentence, after an amount: "0.33 Nm of dry friction".
    scope : which names it can sit at.
    confounders : effects that leave similar traces, and what tells them apart.
    needs : sensors without which it cannot be seen.
    variant : tells apart two realisations under one name; empty for most.
    signed : whether its amounts may have either sign.
    main : kind whose value says how large the effect is.
    steps : amounts the scan tries, in units of the kind's scale; more than one where the response bends.
    everywhere : whether it may well be alike at all places, so that the scan asks for that too.
    passing : whether it happens at some moment, so that held-out data may hold nothing of it.
    includes : simpler effects that are special cases of this one.
    yields_to : effects that are named instead of this one where a log cannot tell them apart.
    held : kinds that a scan takes from the probe as they are, because the response is not linear in them.
    details : kinds that such an effect never goes without, so that having them makes it no less simple.
    """

    title: ClassVar[str] = ""
    confounders: ClassVar[tuple[tuple[str, str], ...]] = ()
    needs: ClassVar[str] = "position"
    variant: ClassVar[str] = ""
    signed: ClassVar[bool] = False
    main: ClassVar[int] = 0
    held: ClassVar[tuple[str, ...]] = ()
    details: ClassVar[tuple[str, ...]] = ()
    steps: ClassVar[tuple[float, ...]] = (2.0,)
    everywhere: ClassVar[bool] = False
    passing: ClassVar[bool] = False
    includes: ClassVar[tuple[str, ...]] = ()
    yields_to: ClassVar[tuple[str, ...]] = ()

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
                values.append(
                    kind.nominal + sum(a * c for a, c in zip(amounts, changes, strict=True))
                )
            values[-1] = float(np.clip(values[-1], kind.lower, kind.upper))
        return np.array(values)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        """The kinds with nominal value, bounds and scale for one place."""
        return cls.kinds

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        """Alternative working points of the scan at one place; each spans the effect linearly."""
        kinds = cls.sized(scale)
        return tuple(
            (tuple(k.nominal + step * k.scale if i == cls.main else k.nominal for i, k in enumerate(kinds)),)
            for step in cls.steps
        )

    @classmethod
    def at(cls, places: Sequence[str], scales: Scales, *, shared: bool = False) -> Self:
        """The effect at some places of a robot whose sizes are known."""
        bare = cls(places=tuple(places), shared=shared and len(places) > 1)
        names = [p.name for p in bare.parameters]
        known: list[Parameter] = []
        for group in bare.groups:
            members = [scale_at(scales, name) for name in group.split(",")]
            largest = max(members, key=lambda s: s.torque_peak)
            for kind in cls.sized(largest):
                known.append(
                    Parameter(
                        names[len(known)], kind.unit, kind.nominal, kind.lower, kind.upper, kind.scale
                    )
                )
        return replace(bare, known=tuple(known))

    def around(self, values: FloatArray) -> Effect:
        """The effect with bounds narrowed to where a search from these values makes sense."""
        return self

    @classmethod
    def ladder(cls, values: FloatArray) -> FloatArray:
        """Amounts (k, kinds) that a refit may begin from, given what a linear scan says (kinds,).

        The response of friction, play, limits and delays bends: the scan's amount can be far off.
        """
        if cls.signed:
            return values[None]
        threshold = cls.kinds[cls.main].name in cls.held
        rungs = np.array(THRESHOLDS if threshold else LADDER)
        anchor = 0.0 if threshold else cls.kinds[cls.main].nominal
        result = np.tile(values, (len(rungs), 1))
        result[:, cls.main] = anchor + rungs * (values[cls.main] - anchor)
        return result

    @property
    def neutral(self) -> FloatArray:
        """(parameters,) values at which the model is exactly the plain one."""
        return np.array([p.nominal for p in self.parameters])


def scale_at(scales: Scales, place: str) -> JointScale:
    """Size at a joint; for a body that of the joint it hangs on; for the robot the largest of all."""
    if place in scales:
        return scales[place]
    whole = list(scales.values())
    return JointScale(
        torque_rms=max(s.torque_rms for s in whole),
        torque_peak=max(s.torque_peak for s in whole),
        velocity_rms=max(s.velocity_rms for s in whole),
        velocity_peak=max(s.velocity_peak for s in whole),
        acceleration_rms=max(s.acceleration_rms for s in whole),
        span=max(s.span for s in whole),
        measured_rms=max(s.measured_rms for s in whole),
        measured_peak=max(s.measured_peak for s in whole),
    )


def middle_scale(scales: Sequence[JointScale]) -> JointScale:
    """Median size of several joints."""
    return JointScale(
        torque_rms=float(np.median([s.torque_rms for s in scales])),
        torque_peak=float(np.median([s.torque_peak for s in scales])),
        velocity_rms=float(np.median([s.velocity_rms for s in scales])),
        velocity_peak=float(np.median([s.velocity_peak for s in scales])),
        acceleration_rms=float(np.median([s.acceleration_rms for s in scales])),
        span=float(np.median([s.span for s in scales])),
        slide=scales[0].slide,
        measured_rms=float(np.median([s.measured_rms for s in scales])),
        measured_peak=float(np.median([s.measured_peak for s in scales])),
    )
