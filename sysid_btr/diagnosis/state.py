"""What a diagnosis knows at some point of its way: one value that every stage takes and returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sysid_btr.diagnosis.closing import Candidate, StepRecord
from sysid_btr.diagnosis.evidence import Evidence
from sysid_btr.estimators.journal import Journal
from sysid_btr.identify.fit import Fit
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.refit import Fitted, inflated, judge, refit, shorten
from sysid_btr.identify.step_check import longest_step
from sysid_btr.identify.study import Study
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.effect import Effect


@dataclass(frozen=True, eq=False)
class State:
    """The model so far, and how it came about.

    Attributes
    ----------
    study : robot and logs, with the noise and the numerics that the model so far asks for.
    first : fit of the declared parameters, the model's first terms.
    before : the same as judged when the search began.
    fitted : the model so far.
    evidence : for each effect, what speaks for its name.
    steps, candidates : for the record.
    replays : candidates simulated.
    estimates : of all parameters; of the declared ones until effects have intervals.
    reported : the model as it is reported, with what cannot be identified fixed; None before there are intervals.
    """

    study: Study
    first: Fit
    before: Fitted
    fitted: Fitted
    evidence: tuple[Evidence, ...]
    steps: tuple[StepRecord, ...]
    candidates: tuple[Candidate, ...]
    replays: int
    estimates: tuple[Estimate, ...]
    reported: Fitted | None = None

    @classmethod
    def of(cls, first: Fit, journal: Journal | None) -> State:
        """The state after the declared parameters were fitted; refits are recorded in a section of a journal."""
        study = replace(first.study, journal=None if journal is None else journal.section())
        # hypotheses are compared where each fits best
        study, before = inflated(study, judge(study, first.model.at(first.optimum), first.replays))
        steps = (StepRecord((), (), before.train, before.holdout),)
        return cls(study, first, before, before, (), steps, (), first.replays, first.estimates)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The terms that were added to the declared ones."""
        added = self.fitted.model.terms[len(self.first.model.terms) :]
        return tuple(term for term in added if isinstance(term, Effect))

    def in_longest_steps(self) -> State:
        """The same in the longest steps that what is left allows; where an effect asked for shorter ones, in those.

        While a model is far from a log a step that suits its noise is a waste.
        """
        if self._steps_are_given:
            return self
        return self._judged_in(longest_step(self.study, self.fitted.model, self.first.study.numerics))

    def in_first_steps(self) -> State:
        """The same in steps no longer than those in which the declared parameters were fitted."""
        return self if self._steps_are_given else self._judged_in(self.first.study.numerics)

    @property
    def _steps_are_given(self) -> bool:
        """Whether they are part of the model, or shorter than the first for what was added."""
        now = self.study.numerics
        return now.exact or now.timestep < self.first.study.numerics.timestep

    def _judged_in(self, numerics: Numerics) -> State:
        if numerics == self.study.numerics:
            return self
        study = replace(self.study, numerics=numerics)
        return replace(self, study=study, fitted=judge(study, self.fitted.model)).spent(1)

    def refitted_without(self, effect: Effect, seconds: float) -> Fitted:
        """What all others come to without an effect, fitted again to so many seconds of each log."""
        return refit(shorten(self.study, seconds), self.fitted.model.without(effect), judged=self.study)

    def spent(self, replays: int) -> State:
        """The same after more simulations."""
        return replace(self, replays=self.replays + replays)

    def step(self, added: Sequence[str] = (), removed: Sequence[str] = ()) -> State:
        """The same with what was added or removed on record."""
        record = StepRecord(tuple(added), tuple(removed), self.fitted.train, self.fitted.holdout)
        return replace(self, steps=(*self.steps, record))

    def without_evidence_of(self, effect: Effect) -> tuple[Evidence, ...]:
        """What speaks for all other effects."""
        at = self.effects.index(effect)
        return self.evidence[:at] + self.evidence[at + 1 :]
