"""Replays and targets as a least-squares problem for the estimators."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.executors.base import HERE, Executor
from sysid_btr.objectives.marginal import Marginal, Projection, projections
from sysid_btr.objectives.targets import Target
from sysid_btr.simulation.batching import batched_chunks, group_replays
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.simulation.subtrees import column_groups, parameter_subtrees, subtrees
from sysid_btr.terms.base import Outputs, Parameter
from sysid_btr.terms.model import Model, Terms

BLOCK = 0.5
"""Seconds; residuals closer than this are allowed to be correlated in standard errors."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """The replay of one episode and what it is compared with.

    Attributes
    ----------
    replay, targets : what is simulated, and the channels it is compared with.
    marginal : where the replay starts from states that are known within an uncertainty, what that can do.
    stretch : s within which residuals may be correlated.
    """

    replay: Replay
    targets: tuple[Target, ...]
    marginal: Marginal | None = None
    stretch: float = BLOCK

    @cached_property
    def projections(self) -> tuple[Projection, ...]:
        """Whitening of every segment whose start is uncertain."""
        return () if self.marginal is None else projections(self.marginal, self.targets)

    def __getstate__(self) -> dict[str, Any]:
        """What another process needs, so that it whitens with the same bits."""
        return {name: getattr(self, name) for name in ("replay", "targets", "marginal", "projections")}

    def raw(self, outputs: Outputs) -> FloatArray:
        """Residuals over sigma, (m, r), target by target, sample by sample; starts are taken as they are."""
        # row by row in memory: a sum over a row must have the same bits whatever candidates are beside it
        result = np.empty((len(outputs.position), sum(int(t.mask.sum()) for t in self.targets)))
        last = 0
        for t in self.targets:
            first, last = last, last + int(t.mask.sum())
            result[:, first:last] = ((t.measured - t.predicted(outputs)) / t.sigma)[:, t.mask]
        return result

    def whitened(self, outputs: Outputs) -> FloatArray:
        """Whitened residuals, (m, r), in the same order."""
        white = self.raw(outputs)
        for projection in self.projections:
            white[:, projection.columns] = projection.whiten(white[:, projection.columns])
        return white

    def errors(self, outputs: Outputs) -> list[FloatArray]:
        """Errors in SI units of the first candidate, (n, k) for each target; NaN where a sample does not count.

        An uncertain start is integrated out, so that they have the size of the noise where the model is right; whatever
        whitens residuals, by the noise: the larger that is taken to be, the less a start is taken to explain.
        """
        plain = replace(self, targets=tuple(replace(t, sigma=t.noise) for t in self.targets))
        white, result, first = plain.whitened(outputs)[0], [], 0
        for projection in plain.projections:
            white[projection.columns] /= projection.weight  # every segment counts in full
        for target in plain.targets:
            error = np.full(target.mask.shape, np.nan)
            last = first + int(target.mask.sum())
            error[target.mask] = white[first:last]
            result.append(error * target.sigma)
            first = last
        return result


@dataclass(frozen=True, eq=False)
class ReplayProblem:
    """Whitened residuals of episodes under candidates: a `ResidualProblem` of the estimators.

    The whitened residual of a sample is (measured - predicted) / sigma; the loss is their sum of squares,
    minus twice the Gaussian log-likelihood up to a constant.

    Attributes
    ----------
    episodes : replays under the same parameters.
    start : (p,) where a search begins.
    executor : where candidates are simulated.
    deviation : decrease of the loss that one standard deviation is worth at least: one where residuals count as their
        independent samples do, and zero where that is not known.
    """

    episodes: tuple[Comparison, ...]
    start: FloatArray
    executor: Executor = HERE
    deviation: float = 0.0

    def __getstate__(self) -> dict[str, Any]:
        """What another process needs; it simulates there."""
        return {"episodes": self.episodes, "start": self.start}

    @property
    def model(self) -> Model:
        """The terms where a search begins."""
        return Model(self.terms, self.start)

    @cached_property
    def terms(self) -> Terms:
        return Terms(self.episodes[0].replay.terms)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.terms.parameters

    @property
    def names(self) -> tuple[str, ...]:
        return self.terms.names

    @cached_property
    def lower(self) -> FloatArray:
        return self.terms.lower

    @cached_property
    def upper(self) -> FloatArray:
        return self.terms.upper

    @cached_property
    def scale(self) -> FloatArray:
        """(p,) size of a change that matters."""
        return self.terms.scale

    @cached_property
    def count(self) -> int:
        """Number of samples that count."""
        return int(sum(target.mask.sum() for e in self.episodes for target in e.targets))

    def residuals(self, candidates: FloatArray) -> FloatArray:
        """Whitened residuals, (m, r), of candidates (m, p); NaN rows where a candidate diverged."""
        return self.executor.run(ReplayProblem._residuals, self, np.atleast_2d(candidates), self.divided)

    def _residuals(self, candidates: FloatArray) -> FloatArray:
        result = np.empty((len(candidates), self.count))
        for i, rows, outputs in self._simulated(candidates):
            result[rows, self._columns_of[i]] = self.episodes[i].whitened(outputs)
        return result

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Sum of squared whitened residuals, (m,); NaN where a candidate diverged."""
        candidates = np.atleast_2d(candidates)
        return np.asarray(self.executor.run(ReplayProblem._losses, self, candidates, self.divided).sum(axis=1))

    def _losses(self, candidates: FloatArray) -> FloatArray:
        """The same of every episode, (m, episodes)."""
        result = np.empty((len(candidates), len(self.episodes)))
        for i, rows, outputs in self._simulated(candidates):
            result[rows, i] = np.sum(self.episodes[i].whitened(outputs) ** 2, axis=1)
        return result

    def errors(self, values: FloatArray) -> FloatArray:
        """Errors, (r,), of one candidate (p,) in SI units, in the order of the residuals; see `Comparison.errors`."""
        return np.asarray(self.executor.run(ReplayProblem._errors, self, values[None], self.divided)[0])

    def _errors(self, candidates: FloatArray) -> FloatArray:
        result = np.empty((1, self.count))
        for i, _, outputs in self._simulated(candidates):
            episode = self.episodes[i]
            pairs = zip(episode.errors(outputs), episode.targets, strict=True)
            result[0, self._columns_of[i]] = np.concatenate([e[t.mask] for e, t in pairs])
        return result

    def divided(self, most: int) -> tuple[tuple[ReplayProblem, float], ...]:
        """Problems in some of the episodes each, at most so many; what they give side by side is what this one does.

        Each with its share of the simulated time. Asked for the same number again, they are the same ones.
        """
        if most not in self._divisions:
            steps = np.array([e.replay.steps for e in self.episodes], dtype=np.float64)
            middle = (np.cumsum(steps) - 0.5 * steps) / steps.sum()
            part = (middle * most).astype(np.int64)
            self._divisions[most] = tuple(
                (
                    replace(self, episodes=tuple(e for e, own in zip(self.episodes, part, strict=True) if own == k)),
                    float(steps[part == k].sum() / steps.sum()),
                )
                for k in np.unique(part)
            )
        return self._divisions[most]

    @cached_property
    def _divisions(self) -> dict[int, tuple[tuple[ReplayProblem, float], ...]]:
        return {}

    @cached_property
    def _groups(self) -> list[tuple[int, ...]]:
        """Episodes that are simulated together."""
        return group_replays([e.replay for e in self.episodes])

    def _simulated(self, candidates: FloatArray) -> Iterator[tuple[int, slice, Outputs]]:
        """Episode, rows of the candidates, and what its sensors show."""
        for group in self._groups:
            for rows, together in batched_chunks([self.episodes[i].replay for i in group], candidates):
                for i, outputs in zip(group, together, strict=True):
                    yield i, rows, outputs

    @cached_property
    def _columns_of(self) -> list[slice]:
        """Where each episode's residuals lie."""
        ends = np.cumsum([0, *(int(sum(t.mask.sum() for t in e.targets)) for e in self.episodes)])
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]

    @cached_property
    def blocks(self) -> IntArray:
        """(r,) label of the stretch of time each residual belongs to, for cluster-robust covariances."""
        labels, offset = [], 0
        for episode in self.episodes:
            time = episode.replay.log.time - episode.replay.log.time[0]
            stretch = (time / episode.stretch).astype(np.int64) + offset
            for target in episode.targets:
                grid = np.broadcast_to(stretch[: len(target.mask), None], target.mask.shape)
                labels.append(grid[target.mask])
            offset = int(stretch.max()) + 1
        return np.concatenate(labels)

    @cached_property
    def column_labels(self) -> IntArray:
        """(r,) index of the log column (episode, channel, joint) each residual belongs to."""
        labels, offset = [], 0
        for episode in self.episodes:
            for target in episode.targets:
                grid = np.broadcast_to(offset + np.arange(len(target.joints)), target.mask.shape)
                labels.append(grid[target.mask])
                offset += len(target.joints)
        return np.concatenate(labels)

    @property
    def columns(self) -> tuple[tuple[int, Target, int], ...]:
        """(episode, target, position in the target) of every log column, as `column_labels` counts them."""
        return tuple(
            (i, target, k)
            for i, episode in enumerate(self.episodes)
            for target in episode.targets
            for k in range(len(target.joints))
        )

    @cached_property
    def inflation(self) -> FloatArray:
        """(columns,) variance by which each column is whitened over that of its noise floor."""
        return np.array([(target.sigma[k] / target.noise[k]) ** 2 for _, target, k in self.columns])

    @cached_property
    def counts(self) -> FloatArray:
        """(columns,) number of residuals."""
        return np.asarray(np.bincount(self.column_labels, minlength=len(self.columns)), dtype=np.float64)

    def column_chi2(self, residual: FloatArray) -> FloatArray:
        """(columns,) mean square of error over noise floor, however the residual (r,) was whitened."""
        sums = np.bincount(self.column_labels, residual**2, len(self.columns))
        return np.asarray(self.inflation * sums / np.maximum(self.counts, 1))

    @cached_property
    def where(self) -> dict[str, int]:
        """Subtree of every joint and body by name; one where a free base joins them in any of the logs."""
        free = (e.replay for e in self.episodes if e.replay.log.meta.mount == "free")
        return subtrees(next(free, self.episodes[0].replay).model)

    @cached_property
    def _subtrees(self) -> tuple[list[frozenset[int]], IntArray]:
        """Subtrees each parameter acts on, and the subtree of each residual."""
        where = self.where
        of_column = np.array([where[target.joints[k]] for _, target, k in self.columns])
        return parameter_subtrees(self.terms, where), of_column[self.column_labels]

    @cached_property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Parameters that can be varied in one simulation, because they move different subtrees."""
        return column_groups(self._subtrees[0])

    def support(self, parameter: int) -> BoolArray | None:
        """(r,) residuals that a parameter can move; None for all."""
        acts_on, subtree = self._subtrees
        own = acts_on[parameter]
        return np.isin(subtree, list(own)) if own else None

    def with_model(self, model: Model) -> ReplayProblem:
        """The same data under another set of terms, and a search that begins at other values."""
        episodes = tuple(replace(e, replay=replace(e.replay, terms=model.terms)) for e in self.episodes)
        return replace(self, episodes=episodes, start=model.values)

    def with_numerics(self, numerics: Numerics) -> ReplayProblem:
        """The same problem under another integrator or step."""
        episodes = tuple(replace(e, replay=replace(e.replay, numerics=numerics)) for e in self.episodes)
        return replace(self, episodes=episodes)


def of_both(
    fitted: ReplayProblem, heldout: ReplayProblem, look: Callable[[ReplayProblem], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """What is seen of two problems, (r,) each; one replay shows both where the one's log begins the other's.

    Parameters
    ----------
    fitted, heldout : under the same terms.
    look : gives a number for every residual of a problem.
    """
    pairs = list(zip(fitted.episodes, heldout.episodes, strict=False))
    longer = [b if _begins(a.replay, b.replay) else a if _begins(b.replay, a.replay) else None for a, b in pairs]
    if len(fitted.episodes) != len(heldout.episodes) or None in longer:
        return look(fitted), look(heldout)
    joined = (replace(e, targets=(*a.targets, *b.targets)) for e, (a, b) in zip(longer, pairs, strict=True) if e)
    seen = look(replace(heldout, episodes=tuple(joined)))
    owner = [(b, int(t.mask.sum())) for pair in pairs for b, e in enumerate(pair) for t in e.targets]
    second = np.repeat([b == 1 for b, _ in owner], [n for _, n in owner])
    return seen[~second], seen[second]


def _begins(a: Replay, b: Replay) -> bool:
    """Whether the one replay is, to the last bit, the beginning of the other."""
    n = len(a.log)
    return (
        type(a) is Replay
        and type(b) is Replay
        and n <= len(b.log)
        and (a.terms, a.numerics, a.effort) == (b.terms, b.numerics, b.effort)
        and a.log.channels.keys() == b.log.channels.keys()
        and all(np.array_equal(v, b.log.channels[k][:n], equal_nan=True) for k, v in a.log.channels.items())
        and np.array_equal(a.log.time, b.log.time[:n])
        and all(np.array_equal(x, y) for x, y in zip(a.start, b.start, strict=True))
        and np.array_equal(a.grid.command, b.grid.command[: a.grid.steps])
        and np.array_equal(a.grid.extra, b.grid.extra[: a.grid.steps])
    )


class Grouped(Protocol):
    """A problem by residuals, parameters of which can be varied in one simulation; see `ReplayProblem`."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def lower(self) -> FloatArray: ...

    @property
    def upper(self) -> FloatArray: ...

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]: ...

    def support(self, parameter: int) -> BoolArray | None: ...

    def residuals(self, candidates: FloatArray) -> FloatArray: ...

    def loss(self, candidates: FloatArray) -> FloatArray: ...


@dataclass(frozen=True, eq=False)
class Conditional:
    """A problem in some of its parameters, the others held.

    Attributes
    ----------
    whole : the problem.
    free : (p,) which parameters are free.
    values : (p,) the held values, and where the free ones start.
    """

    whole: Grouped
    free: BoolArray
    values: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(n for n, f in zip(self.whole.names, self.free, strict=True) if f)

    @property
    def lower(self) -> FloatArray:
        return np.asarray(self.whole.lower[self.free])

    @property
    def upper(self) -> FloatArray:
        return np.asarray(self.whole.upper[self.free])

    @property
    def start(self) -> FloatArray:
        return np.asarray(self.values[self.free])

    def complete(self, candidates: FloatArray) -> FloatArray:
        """Candidates (m, free) with the held values, (m, p)."""
        result = np.tile(self.values, (len(candidates), 1))
        result[:, self.free] = candidates
        return result

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """See `ReplayProblem.groups`."""
        own = {int(i): k for k, i in enumerate(np.flatnonzero(self.free))}
        found = (tuple(own[i] for i in group if i in own) for group in self.whole.groups)
        return tuple(group for group in found if group)

    def support(self, parameter: int) -> BoolArray | None:
        """See `ReplayProblem.support`."""
        return self.whole.support(int(np.flatnonzero(self.free)[parameter]))

    def residuals(self, candidates: FloatArray) -> FloatArray:
        return self.whole.residuals(self.complete(candidates))

    def loss(self, candidates: FloatArray) -> FloatArray:
        return self.whole.loss(self.complete(candidates))
