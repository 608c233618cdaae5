"""The shared recordings of a hanging Nao: the effect that each holds is declared free, beside masses and gains."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.blind.judge import TRUE
from benchmarks.coverage.draw import recipe_state
from benchmarks.coverage.examine import ESTIMATORS, code_state, rounded
from benchmarks.coverage.table import Row
from benchmarks.gantry import FIT, GANTRY, Truth, data_folder

if TYPE_CHECKING:
    from sysid_btr._typing import FloatArray
    from sysid_btr.identify.study import Study
    from sysid_btr.terms.base import Term

BEGIN = 0.7
"""Where the search for an amount begins, as a factor of the true one: away from zero, where some say nothing."""

__all__ = ["GANTRY", "examine_gantry", "recordings"]


def recordings() -> Path | None:
    """Folder of the recordings, None where there are none."""
    folder = data_folder() / "nao_gantry"
    return folder if (folder / "nominal.xml").exists() else None


def examine_gantry(number: int, estimator: str, threads: int = 1) -> list[Row]:
    """One row a parameter of recording `number` (1 is a)."""
    from sysid_btr.identify.fit import fit
    from sysid_btr.identify.study import make_study
    from sysid_btr.io.parquet import read_log
    from sysid_btr.models.builtin import load_robot

    folder = recordings()
    assert folder is not None
    letter = list(GANTRY)[number - 1]
    log = read_log(folder / f"gantry_{letter}.parquet")
    began = perf_counter()
    study = make_study(load_robot(str(folder / "nominal.xml")), [log], threads=threads)
    terms, true, start = declared(study, GANTRY[letter])
    found = fit(study, terms, start=start)
    estimates, converged = ESTIMATORS[estimator](found)
    seconds = perf_counter() - began
    return [
        Row(
            robot="gantry",
            estimator=estimator,
            plant="recorded",
            number=number,
            motion=letter,
            bits=12,
            noise=4.0e-4,
            parameter=e.name,
            true=float(value),
            value=rounded(e.value),
            std=rounded(e.std),
            low=rounded(e.ci95[0]),
            high=rounded(e.ci95[1]),
            identifiable=e.identifiable,
            at_bound=int(e.at_bound),
            converged=int(converged),
            chi2=rounded(found.before.train["position"].chi2),
            seconds=round(seconds, 2),
            recipe=recipe_state(),
            code=code_state(),
        )
        for e, value in zip(estimates, true, strict=True)
    ]


def declared(study: Study, truth: Truth) -> tuple[tuple[Term, ...], FloatArray, FloatArray]:
    """Masses, gains and the effects of a recording as terms; their true values (p,), and a start (p,)."""
    from sysid_btr.terms.library import select_effects

    terms: list[Term] = list(study.declare(FIT))
    true = [_scale(p.name, truth) for m in terms for p in m.parameters]
    start = [1.0] * len(true)
    for planted in truth.effects:
        own = select_effects([planted.name])[0]
        everywhere = not planted.where
        places = planted.where or tuple(study.scales)
        effect = own.at(places, study.scales, shared=everywhere)
        amounts = TRUE[planted.name](planted)
        for parameter in effect.parameters:
            kind = parameter.name.partition(":")[0].partition(".")[2] or next(iter(amounts))
            true.append(amounts[kind])
            start.append(float(np.clip(BEGIN * amounts[kind], parameter.lower, parameter.upper)))
        terms.append(effect)
    return tuple(terms), np.array(true), np.array(start)


def _scale(name: str, truth: Truth) -> float:
    field, _, place = name.partition(":")
    return truth.declared.get(place if field == "mass" else field, 1.0)
