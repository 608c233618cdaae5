"""``sysid-btr posterior``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sysid_btr.cli.fitting import Run, generator, search_of
from sysid_btr.cli.groups import SearchingOptions
from sysid_btr.cli.inputs import check_freed, find_robot
from sysid_btr.cli.kinds import Texts
from sysid_btr.cli.options import option

if TYPE_CHECKING:
    from sysid_btr.estimators.journal import Journal
    from sysid_btr.identify.study import Study
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.progress import ProgressLine


@dataclass(frozen=True, kw_only=True)
class PosteriorOptions(SearchingOptions):
    """Options of `posterior`."""

    priors: Texts = option(
        {},
        "Prior of a parameter, a glob or a whole field: uniform, normal(MEAN, STD), lognormal(MEDIAN, SPREAD).",
        otherwise="the model's table, else uniform within the bounds",
        metavar="NAME=PRIOR",
        decides=True,
    )
    ensembles: int = option(2, "Number of independent ensembles, which must agree.", metavar="N", least=2, decides=True)
    walkers: int | None = option(
        None,
        "Walkers of each ensemble, an even number.",
        otherwise="2 (parameters + 1)",
        metavar="N",
        least=1,
        decides=True,
    )
    max_evaluations: int | None = option(
        None,
        "Maximum number of replays while sampling, converged or not.",
        otherwise="20000",
        metavar="N",
        least=1,
        decides=False,
    )


def posterior(options: PosteriorOptions) -> int:
    """Draw the posterior of the parameters, after a fit.

    Every draw is simulated; sampling goes on until independent ensembles agree. Writes posterior.nc (ArviZ), a
    corner plot, traces and predictions of held-out data with their bands. Exit 5 if it has not converged when the
    replays are used up; the results are written all the same.
    """
    from sysid_btr.estimators.base import Budget
    from sysid_btr.estimators.ensemble import walkers_for
    from sysid_btr.posterior.draw import BUDGET
    from sysid_btr.posterior.draw import posterior as draw_posterior
    from sysid_btr.posterior.export import check_installed
    from sysid_btr.posterior.priors import choose_priors
    from sysid_btr.posterior.sampling import Settings

    check_installed()
    robot = find_robot(options, options.bounds)
    check_freed(robot, options.fit)
    search = search_of(options, robot, None)
    budget = BUDGET if options.max_evaluations is None else Budget(evaluations=options.max_evaluations)

    def job(study: Study, journal: Journal, progress: ProgressLine) -> Posterior:
        terms = study.declare(options.fit)
        choose_priors(terms.parameters, options.priors, robot.priors)
        walkers_for(len(terms.parameters), options.walkers)
        rng = generator(options.seed)
        with progress.phase("fit", 0.2):
            found = search(study, terms, rng, journal, progress)
        return draw_posterior(
            found,
            priors=options.priors,
            settings=Settings(ensembles=options.ensembles, walkers=options.walkers),
            rng=rng,
            budget=budget,
            journal=journal.section(),
            progress=progress,
        )

    return Run.open("posterior", options, robot).carry_out(job)
