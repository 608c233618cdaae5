"""Writing what a run found: result, model, pictures, report."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_btr.run_folder import DRAWS, RESULT, Folder, open_folder

if TYPE_CHECKING:
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.excite.design import Design
    from sysid_btr.identify.fit import Fit
    from sysid_btr.posterior.outcome import Posterior


def save(
    outcome: Fit | Closing | Posterior, out: str | os.PathLike[str], *, seed: int = 0, overwrite: bool = False
) -> Path:
    """Write result.json, model.xml, params.json, overlay.png and report.html of a fit or a closing, as the command
    line does.

    Parameters
    ----------
    outcome : what `fit` or `close` returned.
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


def write_all(folder: Folder, outcome: Fit | Closing | Posterior, result: dict[str, Any]) -> Path:
    """Write all files of a run; the result last, because its presence says that the run is complete.

    The result is given what the model became, and what was drawn.
    """
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.report.pictures import keep, pictures_of, write_report
    from sysid_btr.result import to_json
    from sysid_btr.writeback.write import describe_model

    if isinstance(outcome, Posterior):
        from sysid_btr.posterior.export import netcdf

        folder.write(DRAWS, netcdf(outcome))
    result["pictures"] = keep(folder, pictures_of(outcome))
    describe_model(as_model(outcome), result, folder)
    report = write_report(folder, result)
    folder.write(RESULT, to_json(result))
    return report


def save_motion(folder: Folder, design: Design, result: dict[str, Any]) -> Path:
    """Write motion, figure, report and result of a designed motion; the result last, as in `write_all`.

    Returns
    -------
    Path
        The report.
    """
    from sysid_btr.excite.outcome import MOTION
    from sysid_btr.io.parquet import write_log
    from sysid_btr.report.excitation import plot_motion
    from sysid_btr.report.pictures import keep, write_report
    from sysid_btr.result import to_json

    write_log(design.log, folder.path / MOTION, overwrite=True)
    result["pictures"] = keep(folder, [("excite", lambda: plot_motion(design))])
    report = write_report(folder, result)
    folder.write(RESULT, to_json(result))
    return report


def as_model(outcome: Fit | Closing | Posterior) -> Fit | Closing:
    """What stands for an outcome where one model is asked for: a posterior's means."""
    from sysid_btr.posterior.outcome import Posterior

    return outcome.as_fit if isinstance(outcome, Posterior) else outcome
