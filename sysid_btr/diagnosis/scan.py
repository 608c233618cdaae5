"""Score scan: what every effect at every location would do to the residual, by simulation.

Each effect is simulated at a few working points; its response, projected off what the declared parameters
can do, is compared with the residual. Subtrees that move independently are scanned in one simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.diagnosis.selection import Selection
from sysid_btr.identify.projection import orthonormal
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.subtrees import WHOLE_ROBOT
from sysid_btr.terms.base import Term
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.model import Model
from sysid_btr.terms.scales import Scales, middle_scale, scale_at

FAINT = 1e-4
"""Squared response of a direction, relative to an effect's strongest one, below which it is not moved."""
BLOCK = 256
"""Perturbations whose responses are held at once."""
NO_RESPONSE = 1e-6
"""Response, relative to the residual, below which a log cannot show an effect."""


@dataclass(frozen=True)
class Perturbation:
    """One effect at one place, or alike at several, at one working point."""

    effect: type[Effect]
    places: tuple[str, ...]
    probe: Probe

    @property
    def place(self) -> str:
        """The place, or the first of several."""
        return self.places[0]


@dataclass(frozen=True, eq=False)
class Residual:
    """What is to be explained, beside what some parameters can do.

    Attributes
    ----------
    basis : (r, k) orthonormal; one array for all residuals that are looked at together.
    within : (k, j) orthonormal, in coordinates of `basis`: what the parameters can do.
    rest : (r,) the residual off it.
    """

    basis: FloatArray
    within: FloatArray
    rest: FloatArray

    @classmethod
    def of(cls, residual: FloatArray, jacobian: FloatArray) -> Residual:
        """A residual (r,) beside parameters with these derivatives (r, p)."""
        basis = orthonormal(jacobian)
        return cls(basis, np.eye(basis.shape[1]), residual - basis @ (basis.T @ residual))

    def beside(self, residual: FloatArray, jacobian: FloatArray) -> Residual:
        """Another residual (r,), beside some of the same parameters with these derivatives (r, q)."""
        within = orthonormal(self.basis.T @ jacobian)
        return replace(
            self, within=within, rest=residual - self.basis @ (within @ (within.T @ (self.basis.T @ residual)))
        )

    @property
    def least(self) -> float:
        """Squared response below which a log cannot show an effect."""
        return NO_RESPONSE * float(self.rest @ self.rest) / len(self.rest)


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """How a residual responds to a perturbation.

    Attributes
    ----------
    perturbation : what was simulated.
    residual : what is to be explained.
    rows : (n,) of it that can respond.
    response : (n, directions) change of the whitened residual; one array for all residuals.
    amounts : (directions,) legal multiples that explain most of the residual.
    gain : decrease of the sum of squared residuals.
    values : (kinds,) the effect they stand for.
    """

    perturbation: Perturbation
    residual: Residual
    rows: IntArray
    response: FloatArray
    amounts: FloatArray
    gain: float
    values: FloatArray

    @property
    def explained(self) -> FloatArray:
        """What the multiples change, (n,), projected off what the parameters can do."""
        change, within = self.response @ self.amounts, self.residual.within
        basis = self.residual.basis[self.rows]
        return np.asarray(change - basis @ (within @ (within.T @ (basis.T @ change))))


def perturbations(
    effects: Sequence[type[Effect]],
    places: dict[str, tuple[str, ...]],
    scales: Scales,
    alike: Sequence[tuple[str, ...]] = (),
) -> list[Perturbation]:
    """All effects at all places of their scope, and alike at all places at once, at all working points.

    `alike` are groups of places that have much in common, at which an effect may well be alike too: where limbs push
    each other over a base that moves, what happens in all of them is not the sum of what each would show.
    """
    asked = [
        Perturbation(effect, (place,), probe)
        for effect in effects
        for place in places[effect.scope]
        for probe in effect.probes(scale_at(scales, place))
    ]
    for effect in effects:
        own = places[effect.scope]
        groups = [own, *(g for g in alike if set(g) < set(own))] if effect.everywhere else []
        asked += [
            Perturbation(effect, group, probe)
            for group in groups
            if len(group) > 1
            for probe in effect.probes(middle_scale([scales[p] for p in group]))
        ]
    return asked


def scan(
    problem: ReplayProblem,
    values: FloatArray,
    residual: FloatArray,
    jacobian: FloatArray,
    asked: Sequence[Perturbation],
    scales: Scales,
    rules: Selection,
) -> list[Sensitivity]:
    """Simulate every perturbation, and what it explains of the residual that a fit has left.

    Parameters
    ----------
    problem : data and declared terms.
    values : (p,) fitted.
    residual, jacobian : (r,) and (r, p) there, whitened; at their end what is known of the parameters beside the data.
    asked : effects, places, working points.
    scales : sizes at the joints.
    rules : where costly perturbations are tried.

    Returns
    -------
    list of Sensitivity
        Those that respond at all, best first.
    """
    return responding(problem, values, [Residual.of(residual, jacobian)], asked, scales, rules)[0]


def responding(
    problem: ReplayProblem,
    values: FloatArray,
    residuals: Sequence[Residual],
    asked: Sequence[Perturbation],
    scales: Scales,
    rules: Selection,
) -> list[list[Sensitivity]]:
    """The same for several residuals, (r,) each, beside different parameters: every perturbation is simulated once.

    What it does is simulated in the model of `problem` at `values`; what it explains is judged for each residual. All
    have one `basis`.
    """
    plain = [q for q in asked if not _costly(q)]
    found = _simulate(problem, values, residuals, plain, scales) if plain else [[] for _ in residuals]
    dear = [q for q in asked if _costly(q)]
    near = {q for own in found for q in where_something_is(plain, own, dear, rules)}
    costly = [q for q in dear if q in near]
    batches = [[q for q in costly if not q.effect.structural]]
    batches += _by_structure([q for q in costly if q.effect.structural], problem)
    for batch in filter(None, batches):
        for own, more in zip(found, _simulate(problem, values, residuals, batch, scales), strict=True):
            own += more
    return [sorted(own, key=lambda t: -t.gain) for own in found]


def _costly(perturbation: Perturbation) -> bool:
    """Whether the effect acts step by step, or needs another model."""
    return perturbation.effect.structural or perturbation.effect.overrides("law")


def where_something_is(
    plain: Sequence[Perturbation], found: Sequence[Sensitivity], costly: Sequence[Perturbation], rules: Selection
) -> list[Perturbation]:
    """Perturbations at places at which some simpler effect explains something, of what the best explains anywhere.

    What an effect does at a joint follows its command, position, velocity, acceleration or load, and so does what one
    of the simpler ones does there. A place that is passed over is asked about again once others are explained.
    """
    best = dict.fromkeys((q.place for q in plain if len(q.places) == 1), 0.0)
    for one in found:
        if len(one.perturbation.places) == 1:
            best[one.perturbation.place] = max(best[one.perturbation.place], one.gain)
    least = rules.costly_share * max(best.values(), default=0.0)
    return [q for q in costly if len(q.places) > 1 or best.get(q.place, least) >= least]


def _subtree(perturbation: Perturbation, where: dict[str, int]) -> int:
    found = {where.get(place, WHOLE_ROBOT) for place in perturbation.places}
    return found.pop() if len(found) == 1 else WHOLE_ROBOT


def _by_structure(asked: list[Perturbation], problem: ReplayProblem) -> list[list[Perturbation]]:
    """Structural perturbations that can share one compiled model: one place a subtree."""
    where = problem.where
    result: list[list[Perturbation]] = []
    for effect in dict.fromkeys(q.effect for q in asked):
        own = [q for q in asked if q.effect is effect and len(q.places) == 1]
        result += [[q] for q in asked if q.effect is effect and len(q.places) > 1]
        waiting = list(dict.fromkeys(q.place for q in own))
        while waiting:
            used: set[int] = set()
            here = []
            for place in list(waiting):
                subtree = where[place]
                if subtree not in used:
                    used.add(subtree)
                    here.append(place)
                    waiting.remove(place)
            result.append([q for q in own if q.place in here])
    return result


def _simulate(
    problem: ReplayProblem, values: FloatArray, residuals: Sequence[Residual], asked: list[Perturbation], scales: Scales
) -> list[list[Sensitivity]]:
    """Simulate perturbations that share a set of terms: those that respond at all, for each residual."""
    where = problem.where
    model, columns = Model(problem.terms, values), {}
    for effect in dict.fromkeys(q.effect for q in asked):
        places = tuple(dict.fromkeys(p for q in asked if q.effect is effect for p in q.places))
        term = effect.at(places, scales)
        first = len(model.values)
        for i, place in enumerate(places):
            columns[effect, place] = slice(first + i * len(effect.kinds), first + (i + 1) * len(effect.kinds))
        model = model.with_(term, term.neutral)
    wide, neutral, nominal = problem.with_model(model), model.values, model.terms.nominal
    # one simulation carries one direction of one perturbation in each subtree
    groups: dict[int, list[tuple[int, int]]] = {}
    for i, perturbation in enumerate(asked):
        for d in range(len(perturbation.probe)):
            groups.setdefault(_subtree(perturbation, where), []).append((i, d))
    alone = groups.pop(WHOLE_ROBOT, [])
    depth = max((len(group) for group in groups.values()), default=0)
    jobs = [[group[k] for group in groups.values() if k < len(group)] for k in range(depth)]
    jobs += [[item] for item in alone]
    candidates = np.tile(neutral, (1 + len(jobs), 1))
    for row, job in enumerate(jobs, start=1):
        for i, d in job:
            perturbation = asked[i]
            for gone in _replaced(model, perturbation):
                candidates[row, gone] = nominal[gone]
            for place in perturbation.places:
                candidates[row, columns[perturbation.effect, place]] = perturbation.probe[d]
    subtree_of_row = wide._subtrees[1]
    responses: dict[tuple[int, int], FloatArray | None] = {}
    everywhere = np.arange(len(residuals[0].basis))
    # what is known of the parameters beside the log no effect moves, but all of them may spare the parameters
    beside = everywhere[len(subtree_of_row) :]
    rows_of = {s: np.concatenate([np.flatnonzero(subtree_of_row == s), beside]) for s in groups}
    asks = [[], *jobs]  # the first candidate asks nothing: the others are compared with it
    for first in range(0, len(candidates), BLOCK):
        block = wide.residuals(candidates[first : first + BLOCK])
        if first == 0:
            base = block[0].copy()
        changes = np.pad(block - base, ((0, 0), (0, len(beside))))
        for change, job in zip(changes, asks[first : first + BLOCK], strict=True):
            for i, d in job:
                rows = rows_of.get(_subtree(asked[i], where), everywhere)
                finite = np.isfinite(change).all()
                responses[i, d] = change[rows] if finite else None
    bases = {subtree: residuals[0].basis[rows] for subtree, rows in rows_of.items()}
    judged: list[list[Sensitivity]] = [[] for _ in residuals]
    for i, perturbation in enumerate(asked):
        known = [c for d in range(len(perturbation.probe)) if (c := responses.pop((i, d))) is not None]
        if len(known) < len(perturbation.probe):
            continue
        subtree, response = _subtree(perturbation, where), np.column_stack(known)
        rows = rows_of.get(subtree, everywhere)
        coordinates = bases.get(subtree, residuals[0].basis).T @ response
        for own, residual in zip(judged, residuals, strict=True):
            answer = _judge(perturbation, residual, rows, response, coordinates, scales)
            if answer is not None:
                own.append(answer)
    return judged


def _replaced(model: Model, perturbation: Perturbation) -> list[slice]:
    """Where the numbers stand of what an effect that a probe gives whole takes the place of.

    What it does beside that would be another thing: of commands that come late already, other moments are taken.
    """
    effect, places = perturbation.effect, perturbation.places
    if len(effect.held) < len(effect.kinds):
        return []
    return [model.terms.columns(known) for known in model.terms if is_special_case(known, effect, places)]


def is_special_case(known: Term, effect: type[Effect], places: Sequence[str]) -> bool:
    """Whether an effect at some places includes what is known there, and takes its place."""
    if not isinstance(known, Effect):
        return False
    return (known.label or known.name) in effect.includes and set(known.places) <= set(places)


def _judge(
    perturbation: Perturbation,
    residual: Residual,
    rows: IntArray,
    response: FloatArray,
    coordinates: FloatArray,
    scales: Scales,
) -> Sensitivity | None:
    """How much of a residual legal multiples of a response explain, which has these coordinates (k, directions)."""
    coefficients = residual.within.T @ coordinates
    with np.errstate(over="ignore", invalid="ignore"):  # of a replay that is about to diverge; not judged
        gram = response.T @ response - coefficients.T @ coefficients
    # the residual is off the basis, so what the projection takes, here and from other subtrees, has no part in this
    inner = response.T @ residual.rest[rows]
    if not np.all(np.isfinite(gram)) or np.max(np.diag(gram)) <= residual.least:
        return None
    # the residual is measured minus predicted, so a response that explains it has the opposite sign
    amounts = _legal(perturbation.effect, gram, -inner)
    gain = float(-2 * amounts @ inner - amounts @ gram @ amounts)
    values = perturbation.effect.combine(scale_at(scales, perturbation.place), perturbation.probe, amounts)
    if values is None or gain <= 0:
        return None
    return Sensitivity(perturbation, residual, rows, response, amounts, gain, values)


def _legal(effect: type[Effect], gram: FloatArray, target: FloatArray) -> FloatArray:
    """Amounts under the effect's signs that explain most; working points of thresholds are not stretched far."""
    amounts = best_multiples(gram, target, signed=effect.signed)
    if not effect.signed and effect.held and len(effect.held) == len(effect.kinds):
        amounts = np.minimum(amounts, 1.5)
    return amounts


def best_multiples(gram: FloatArray, target: FloatArray, *, signed: bool) -> FloatArray:
    """Minimise a'Ga - 2 a't, over a that is not negative unless it has a sign of its own."""
    if signed:
        # directions that hardly any sensor sees stay at zero
        return np.asarray(np.linalg.pinv(gram, rcond=FAINT, hermitian=True) @ target)
    from scipy.optimize import nnls

    values, vectors = np.linalg.eigh(gram)
    root = np.sqrt(np.maximum(values, 1e-12 * max(values[-1], 1e-300)))
    return np.asarray(nnls(root[:, None] * vectors.T, (vectors.T @ target) / root)[0])
