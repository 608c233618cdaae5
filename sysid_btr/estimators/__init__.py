"""Estimators: least squares, genetic algorithm, CMA-ES, NLopt; one contract, one evaluator, one journal.

>>> from sysid_btr.estimators import Budget, Journal, get_estimator, silent
>>> estimator = get_estimator("lsq", n_starts=3)
>>> # estimator.fit(problem, rng=rng, budget=Budget(evaluations=500), journal=Journal(), progress=silent)
"""

from sysid_btr.estimators.base import (
    Budget,
    Estimator,
    FitResult,
    Problem,
    Progress,
    ResidualEstimator,
    ResidualProblem,
    Termination,
    UnitBox,
    has_residuals,
    require_residuals,
    silent,
    uses_residuals,
)
from sysid_btr.estimators.chain import Chain, needs_residuals
from sysid_btr.estimators.cma_es import CmaEs
from sysid_btr.estimators.derivative_free import NLopt
from sysid_btr.estimators.ensemble import Ensemble
from sysid_btr.estimators.evaluator import Evaluator, Outcome, Reduced, Stop, drive
from sysid_btr.estimators.ga import GeneticAlgorithm
from sysid_btr.estimators.journal import Journal, Record
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.estimators.registry import available, get_estimator

__all__ = [
    "Budget",
    "Chain",
    "CmaEs",
    "Ensemble",
    "Estimator",
    "Evaluator",
    "FitResult",
    "GeneticAlgorithm",
    "Journal",
    "LeastSquares",
    "NLopt",
    "Outcome",
    "Problem",
    "Progress",
    "Record",
    "Reduced",
    "ResidualEstimator",
    "ResidualProblem",
    "Stop",
    "Termination",
    "UnitBox",
    "available",
    "drive",
    "get_estimator",
    "has_residuals",
    "linearise",
    "needs_residuals",
    "require_residuals",
    "silent",
    "uses_residuals",
]
