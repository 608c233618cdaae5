"""Writing what a run found: result, model, pictures, report."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_btr.run_folder import DRAWS, Folder, open_folder

if TYPE_CHECKING:
    import pandas as pd

    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.excite.design import Design
    from sysid_btr.identify.fit import Fit
    from sysid_btr.posterior.outcome import Posterior


def save(
    outcome: Fit | Closing | Posterior, out: str | os.PathLike[str], *, seed: int = 0, overwrite: bool = False
) -> Path:
    """Write result.json, model.xml, params.json, pictures, report.html and explore.html of an outcome, as the command
    line does.

    Parameters
    ----------
    outcome : what `fit`, `close` or `posterior` returned.
    out : folder, created if missing.
    seed : of the generator the estimator was given; recorded.
    overwrite : whether earlier results in the folder may be replaced.

    Returns
    -------
    Path
        The report.
    """
    folder = open_folder(Path(out), overwrite=overwrite)
    return write_all(folder, outcome, outcome.to_dict(seed=seed))


def tables(of: Fit | Closing | Posterior | Mapping[str, Any] | str | os.PathLike[str]) -> dict[str, pd.DataFrame]:
    """Every number of a result as pandas DataFrames, by name.

    >>> sb.tables("out")["parameters"].loc["mass:Knee", ["value", "ci95_low", "ci95_high"]]  # doctest: +SKIP

    Parameters
    ----------
    of : an outcome, a result, or the folder (or result.json) of a finished run.

    Returns
    -------
    dict of str to DataFrame
        See `sysid_btr.display.tables.to_tables`.

    Raises
    ------
    UsageError
        If there is no result in that folder.
    """
    from sysid_btr.display.tables import to_tables
    from sysid_btr.result import read_result

    if isinstance(of, Mapping):
        return to_tables(of)
    return to_tables(read_result(of) if isinstance(of, str | os.PathLike) else of.to_dict())


def write_all(folder: Folder, outcome: Fit | Closing | Posterior, result: dict[str, Any]) -> Path:
    """Write all files of a run: what was computed, and then what is drawn of it.

    The result is given what the model became, and what was drawn.
    """
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.report.explore import explorable
    from sysid_btr.report.pictures import pictures_of, write_pages
    from sysid_btr.report.traces import play
    from sysid_btr.writeback.write import describe_model

    if isinstance(outcome, Posterior):
        from sysid_btr.posterior.export import netcdf

        folder.write(DRAWS, netcdf(outcome))
    describe_model(as_model(outcome), result, folder)
    played = cache(lambda: play(outcome))
    return write_pages(folder, result, pictures_of(outcome, played), lambda: explorable(played()))


def save_motion(folder: Folder, design: Design, result: dict[str, Any]) -> Path:
    """Write motion, result, figure and report of a designed motion.

    Returns
    -------
    Path
        The report.
    """
    from sysid_btr.excite.outcome import MOTION
    from sysid_btr.io.parquet import write_log
    from sysid_btr.report.excitation import plot_motion
    from sysid_btr.report.pictures import write_pages

    write_log(design.log, folder.path / MOTION, overwrite=True)
    return write_pages(folder, result, [("excite", lambda: plot_motion(design))])


def as_model(outcome: Fit | Closing | Posterior) -> Fit | Closing:
    """What stands for an outcome where one model is asked for: a posterior's means."""
    from sysid_btr.posterior.outcome import Posterior

    return outcome.as_fit if isinstance(outcome, Posterior) else outcome
