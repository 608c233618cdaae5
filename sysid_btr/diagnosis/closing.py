"""What closing the loop returns: the verdict, the effects with intervals, and every step of the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from sysid_btr._typing import FloatArray
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.nuisance import assumptions
from sysid_btr.identify.outcome import StudyOutcome
from sysid_btr.identify.scores import Scores
from sysid_btr.identify.study import Study
from sysid_btr.terms.model import Model
from sysid_btr.units import probability

Verdict = Literal["explained", "partly_explained", "nothing_missing", "ambiguous", "unexplained"]


@dataclass(frozen=True, repr=False)
class NamedEffect:
    """An effect that the log shows and the model lacked.

    Attributes
    ----------
    effect : name, as in the library.
    family : of causes that it is a form of.
    variant : realisation under that name, or empty.
    where : joint or body names, or ``robot``.
    parameters : how large, with intervals.
    certainty : probability that a cause of this family acts there, see `sysid_btr.diagnosis.certainty`.
    otherwise : probabilities of other families, the likeliest first.
    explains : share of the error above the noise floor (squared) that vanishes with it, ``train`` and ``holdout``, of
        what is left without it once all others are fitted again.
    provisional : whether something is left where it acts, so that its form, or it, may be another.
    gain_holdout : fraction of the held-out chi2 that vanishes with it, likewise.
    confused_with : effects with which it is confounded on this log, and itself at another place (``payload at thigh``).
    sentence : the finding in words.
    evidence : what the certainty rests on, by name.
    """

    effect: str
    family: str
    variant: str
    where: tuple[str, ...]
    parameters: tuple[Estimate, ...]
    certainty: float
    otherwise: Mapping[str, float]
    explains: Mapping[str, float]
    provisional: bool
    gain_holdout: float
    confused_with: tuple[str, ...]
    sentence: str
    evidence: Mapping[str, float]

    def __repr__(self) -> str:
        return (
            f"<NamedEffect {self.sentence or self.effect}; {self.family} with {probability(self.certainty)} certainty>"
        )

    @property
    def likely(self) -> bool:
        """Whether the name is more likely right than not."""
        return self.certainty > 0.5


@dataclass(frozen=True)
class Candidate:
    """An effect that was weighed, and how much of the residual it would explain.

    Attributes
    ----------
    effect, where : what and where.
    explained : fraction of the excess residual on the held-out part.
    amplitude : value of its main parameter.
    confused_with : other candidates whose trace in this log is nearly the same.
    round : of the search, from 1.
    amounts : value of its main parameter at each place.
    why : what became of it, and why.
    """

    effect: str
    where: tuple[str, ...]
    explained: float
    amplitude: float
    confused_with: tuple[str, ...]
    round: int = 0
    amounts: Mapping[str, float] = field(default_factory=dict)
    why: str = ""


@dataclass(frozen=True)
class StepRecord:
    """One step: what was added or removed, and the whitened mean square error (chi2) it led to."""

    added: tuple[str, ...]
    removed: tuple[str, ...]
    train: float
    holdout: float


@dataclass(frozen=True, eq=False, repr=False)
class Closing(StudyOutcome):
    """Result of closing the loop.

    Attributes
    ----------
    study : as diagnosed; its numerics may have been refined.
    verdict, message : the finding, and one sentence on it.
    noise_floor : by channel, SI.
    nominal, before, after : scores of the plain model, with declared parameters, with the effects that are named.
    parameters : declared parameters beside the effects that are named.
    effects : what was missing.
    candidates : what was weighed, best first.
    steps : every step of the way.
    signature : of the residual that is left, when unexplained or where effects that are named leave much of it.
    before_model, model : with the declared parameters fitted, and with what was missing; where nothing is named, with
        what comes nearest.
    replays, seconds : cost.
    """

    study: Study
    verdict: Verdict
    message: str
    noise_floor: Mapping[str, float]
    nominal: Scores
    before: Scores
    after: Scores
    parameters: tuple[Estimate, ...]
    effects: tuple[NamedEffect, ...]
    candidates: tuple[Candidate, ...]
    steps: tuple[StepRecord, ...]
    signature: Mapping[str, Any] | None
    before_model: Model
    model: Model
    replays: int
    seconds: float

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """All of the model that is reported: the declared parameters, then those of the effects."""
        return (*self.parameters, *(p for e in self.effects for p in e.parameters))

    @property
    def values(self) -> FloatArray:
        """(p,) values of all parameters of the final model."""
        return self.model.values

    @property
    def found(self) -> dict[str, Any]:
        """What results of kind ``close`` have beside study and cost."""
        return {
            "kind": "close",
            "verdict": self.verdict,
            "message": self.message,
            "noise_floor": dict(self.noise_floor),
            "nominal": self.nominal.to_dict(),
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
            "parameters": [e.to_dict() for e in self.parameters],
            "effects": [{**asdict(e), "parameters": [p.to_dict() for p in e.parameters]} for e in self.effects],
            "candidates": [asdict(c) for c in self.candidates],
            "steps": [asdict(s) for s in self.steps],
            "signature": self.signature,
            **assumptions(self.study, self.model.terms),
        }
