"""From what speaks for a name to the probability that it is right.

A weight among models that were tried says nothing of causes that the library does not have, and a form that is nearly
right leaves something. So the probability is a logistic function of both (Platt 1999, "Probabilistic outputs for
support vector machines"). Its numbers were set on 18 logs of `benchmarks.blind` (series 7): right names left at most
1.2 % where they act, imitations 36 to 77 %. A calibration on hundreds of logs that set nothing is still to come.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

FAINT = 1e-3
"""How near to 0 and 1 a share is believed."""

UNSIZED = 0.5
"""Most that is said of a name beside others, each of whose numbers may be nothing: it is not more likely than not. Of
such names in `benchmarks.blind` (series 41 to 46, shape) 7 of 16 are right, and 7 of 7 that stand alone."""


@dataclass(frozen=True)
class Calibration:
    """Log-odds that a name is right, linear in what is known of it.

    Attributes
    ----------
    constant : log-odds where a name has half the weight, and half of the excess is left.
    family, place : by log-odds of the weight of its family, and of its place, among what was tried.
    explained : by log-odds of the share of the excess that is gone where it acts.
    """

    constant: float
    family: float
    place: float
    explained: float

    def certainty(self, evidence: Mapping[str, float], *, sized: bool = True) -> float:
        """Probability, 0 to 1, from the evidence of an effect, of which some number is not nothing if it is `sized`."""
        total = (
            self.constant
            + self.family * log_odds(evidence["family"])
            + self.place * log_odds(evidence["place"])
            + self.explained * log_odds(1 - evidence["left"])
        )
        probability = 1 / (1 + math.exp(-total))
        return probability if sized else min(probability, UNSIZED)


def log_odds(share: float) -> float:
    """Of a share, 0 to 1, that is known to no more than `FAINT`."""
    known = min(max(share, FAINT), 1 - FAINT)
    return math.log(known / (1 - known))


STANDARD = Calibration(constant=-2.2, family=0.2, place=0.0, explained=1.2)
