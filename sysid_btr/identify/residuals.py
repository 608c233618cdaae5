"""What a model leaves of the samples that it is compared with, as a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sysid_btr.identify.study import Study
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.objectives.targets import COMPARED
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("log", "episode", "part", "channel", "joint", "time", "measured", "predicted", "residual", "noise")


def residuals(study: Study, model: Model) -> pd.DataFrame:
    """Every sample of a study that is compared with a model, fitted channels or not, one row each; see `COLUMNS`.

    SI units; time in s since the first sample of the episode; ``noise`` is the noise floor. The prediction of a log
    that is compared by segments begins each where the log wants it, as the scores do.
    """
    import pandas as pd

    wide = replace(study, channels=COMPARED)
    parts = (("train", wide.train_problem(model)), ("holdout", wide.holdout_problem(model)))
    found = [pd.DataFrame(entry) for part, problem in parts for entry in _columns(part, problem)]
    return pd.concat(found, ignore_index=True) if found else pd.DataFrame(columns=list(COLUMNS))


def _columns(part: str, problem: ReplayProblem) -> Iterator[dict[str, Any]]:
    """Rows of each sensor of each episode."""
    counted: Counter[str] = Counter()
    for episode in problem.episodes:
        log = episode.replay.log
        name = "" if log.path is None else log.path.name
        errors = episode.errors(episode.replay.predict(problem.start[None]))
        for target, error in zip(episode.targets, errors, strict=True):
            time = (log.time - log.time[0])[: len(target.mask)]
            for k, joint in enumerate(target.joints):
                rows = target.mask[:, k]
                measured, left = target.measured[rows, k], error[rows, k]
                where = (name, counted[name], part, target.channel, joint)
                values = (time[rows], measured, measured - left, left, float(target.noise[k]))
                yield dict(zip(COLUMNS, (*where, *values), strict=True))
        counted[name] += 1
