"""``sysid-btr fit``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from sysid_btr.cli.fitting import Run, generator, search_of
from sysid_btr.cli.groups import NuisanceOptions, SearchingOptions
from sysid_btr.cli.inputs import check_freed, find_robot
from sysid_btr.cli.options import option

if TYPE_CHECKING:
    from sysid_btr.estimators.journal import Journal
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.study import Study
    from sysid_btr.progress import ProgressLine


@dataclass(frozen=True, kw_only=True)
class FitOptions(NuisanceOptions, SearchingOptions):
    """Options of `fit`."""

    max_evaluations: int | None = option(
        None, "Maximum number of replays of the search.", metavar="N", least=1, decides=False
    )
    profile: tuple[str, ...] = option(
        (),
        "Also follow the likelihood along this parameter (name or glob), the others fitted anew at each point: "
        "profile_NAME.png.",
        metavar="NAME",
        decides=False,
    )


def fit(options: FitOptions) -> int:
    """Fit parameters of the model: values, intervals, held-out error.

    Without --fit, lists what can be fitted. Exit 5 if the search did not converge or none of the parameters is
    identifiable; the results are written all the same.
    """
    from sysid_btr.identify.profile import chosen_names, with_profiles

    robot = find_robot(options, options.bounds)
    check_freed(robot, options.fit)
    search = search_of(options, robot, options.max_evaluations)

    def job(study: Study, journal: Journal, progress: ProgressLine) -> Fit:
        study = replace(study, nuisance=options.nuisance)
        terms = study.declare(options.fit)
        wanted = chosen_names(terms.names, options.profile)
        return with_profiles(search(study, terms, generator(options.seed), journal, progress), wanted, progress)

    return Run.open("fit", options, robot).carry_out(job)
