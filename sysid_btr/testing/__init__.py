"""For those who extend sysid_btr: toy problems with known answers, and the checks that every extension must pass.

>>> from sysid_btr.estimators import get_estimator
>>> from sysid_btr.testing import check_estimator
>>> check_estimator(get_estimator("lsq"))
"""

from sysid_btr.testing.estimator import (
    ESTIMATOR_CHECKS,
    Killed,
    Witness,
    check_budget,
    check_by_residuals,
    check_estimator,
    check_failing_candidates,
    check_interruption,
    check_progress,
    check_refusals,
    check_reproducible,
    check_result,
    check_resume,
    run,
)
from sysid_btr.testing.importer import IMPORTER_CHECKS, check_importer
from sysid_btr.testing.problems import (
    LossOnly,
    ToyProblem,
    bound_active,
    exponential_decay,
    failing_region,
    hopeless,
    linear_gaussian,
    lone_parameter,
    rank_deficient,
    rosenbrock,
)
from sysid_btr.testing.require import require
from sysid_btr.testing.simulator import SIMULATOR_CHECKS, check_simulator
from sysid_btr.testing.term import TERM_CHECKS, TermBench, check_term, toy_motion, toy_robot

__all__ = [
    "ESTIMATOR_CHECKS",
    "IMPORTER_CHECKS",
    "SIMULATOR_CHECKS",
    "TERM_CHECKS",
    "Killed",
    "LossOnly",
    "TermBench",
    "ToyProblem",
    "Witness",
    "bound_active",
    "check_budget",
    "check_by_residuals",
    "check_estimator",
    "check_failing_candidates",
    "check_importer",
    "check_interruption",
    "check_progress",
    "check_refusals",
    "check_reproducible",
    "check_result",
    "check_resume",
    "check_simulator",
    "check_term",
    "exponential_decay",
    "failing_region",
    "hopeless",
    "linear_gaussian",
    "lone_parameter",
    "rank_deficient",
    "require",
    "rosenbrock",
    "run",
    "toy_motion",
    "toy_robot",
]
