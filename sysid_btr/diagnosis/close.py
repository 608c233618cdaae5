"""Closing the loop: find the residual, trace it to an effect the model lacks, add it, report before and after."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.closing import Closing
from sysid_btr.diagnosis.elimination import eliminate
from sysid_btr.diagnosis.search import search
from sysid_btr.diagnosis.selection import STANDARD, Selection
from sysid_btr.diagnosis.split import held_out_elsewhere
from sysid_btr.diagnosis.state import State
from sysid_btr.diagnosis.uncertainty import with_discrepancy
from sysid_btr.diagnosis.verdict import conclude, named_effects, verdict_of
from sysid_btr.errors import LogError
from sysid_btr.estimators.base import Progress
from sysid_btr.estimators.journal import Journal
from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import Study
from sysid_btr.io._text import some
from sysid_btr.io.noise import is_white
from sysid_btr.models.commands import drives_nothing
from sysid_btr.progress import phase, shows_progress, watched
from sysid_btr.terms.base import Term
from sysid_btr.terms.effect import COMMANDS, GROUND, HELD_BASE, Effect, family_of
from sysid_btr.terms.free_form import FREE_FORMS
from sysid_btr.terms.library import select_effects

if TYPE_CHECKING:
    from numpy.random import Generator

    from sysid_btr.io.log import Log

OF_DRIVES = ("delay", "gain", "saturation", "servo law", "supply")
"""Families of what a drive makes of its command: none where the torque that it gave moves the model."""


@shows_progress("close")
def close(
    study: Study,
    parameters: Sequence[str] | Sequence[Term],
    *,
    effects: Sequence[str] = ("all",),
    rng: Generator | None = None,
    journal: Journal | None = None,
    progress: Progress = watched,
    start: FloatArray | None = None,
    selection: Selection = STANDARD,
) -> Closing:
    """Name the effects that a model lacks.

    Fit what is declared; scan every effect at every location; refit the leading hypotheses; let held-out data decide;
    add the winner; repeat; drop what is not missed. An effect is added only if held-out data say so, and each is given
    with how sure its name is; where nothing is more likely than not, nothing is named.

    Parameters
    ----------
    study : robot and logs.
    parameters : what is declared free, as for `fit`.
    effects : names of the effects to consider, or ``all``.
    rng : for estimators that draw; not used by the default ones.
    journal, progress : see `sysid_btr.estimators`.
    start : (p,) where the declared parameters begin; default the nominal values.
    selection : what is asked, and what it takes to be tried, added, kept and named.

    Returns
    -------
    Closing
        Verdict, effects with intervals, candidates, steps.

    Examples
    --------
    >>> close(study, ["mass:*"], selection=Selection(minimum_gain=2e-4))  # doctest: +SKIP
    """
    began = perf_counter()
    asked = select_effects(effects)
    if "all" in effects:
        asked = (*asked, *FREE_FORMS)
    require_motion(study)
    elsewhere: Study | None = study
    while elsewhere is not None:
        study = elsewhere
        with phase("fit", 0.2):
            first = fit(study, parameters, rng=rng, journal=journal, progress=progress, start=start)
        state = State.of(first, journal)
        library = usable_effects(asked, study)
        elsewhere = held_out_elsewhere(state, selection)
        if elsewhere is None:
            with phase("search", 0.7):
                state = search(state, library, selection, progress)
            with phase("elimination", 0.8):
                state = with_discrepancy(eliminate(state, library, selection, progress))
            floating = state.study.procedure.leaves_ground_error
            named, spent = named_effects(state, selection)
            state = state.spent(spent)
            verdict = verdict_of(selection, state.before, state.fitted, named, floating=floating)
            short = verdict in ("unexplained", "partly_explained")
            elsewhere = held_out_elsewhere(state, selection) if short else None
        journal = journal and journal.section()
    return conclude(state, verdict, named, selection, perf_counter() - began)


def require_motion(study: Study) -> None:
    """Refuse logs that hold no motion: whatever the model does, nothing in them would speak against it.

    Raises
    ------
    LogError
        If every column that is fitted is constant, or noise alone.
    """
    problem = study.train_problem(())
    if all(is_white(t.measured[t.mask[:, k], k]) for _, t, k in problem.columns):
        names = dict.fromkeys(f"{t.channel}.{t.joints[k]}" for _, t, k in problem.columns)
        raise LogError(
            f"nothing moves in this log: {some(names, 6)} hold constant values or noise alone, in which no effect "
            "would show. Record a motion (`sysid-btr excite` designs one)"
        )


def usable_effects(effects: Sequence[type[Effect]], study: Study) -> tuple[type[Effect], ...]:
    """Effects that these logs could show at all, given mount and channels."""
    on_ground = any(episode.procedure.on_ground for episode in study.train)
    replayed = any(episode.procedure.replayed for episode in study.train)
    given = all(drives_nothing(episode.log, study.robot.for_log(episode.log).model) for episode in study.train)
    result = []
    for effect in filter(study.shows, effects):
        if given and effect.scope != "joint" and family_of(effect) in OF_DRIVES:
            continue
        if effect.needs == (HELD_BASE if on_ground else GROUND) or (effect.needs == COMMANDS and not replayed):
            continue
        if effect.needs == "effort" and not any(episode.logged(("effort",)) for episode in study.train):
            continue
        if effect.needs == "enabled" and not any(_switched(episode.log) for episode in study.train):
            continue
        result.append(effect)
    return tuple(result)


def _switched(log: Log) -> bool:
    """Whether a drive is off for a part of the log."""
    return any(bool(np.any(v == 0)) for name, v in log.channels.items() if name.startswith("enabled."))
