"""Which effects are of one cause, so that a curve may stand in the place of all of them."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from sysid_btr.diagnosis.joining import of_one_cause
from sysid_btr.terms.disturbance import ExternalDisturbance
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.free_form import FreeFrictionSpeed, FreeTorquePeriodic
from sysid_btr.terms.friction import CoulombFriction, ViscousDamping
from sysid_btr.terms.scales import JointScale, Scales

SCALES: Scales = dict.fromkeys(("knee", "hip"), JointScale(1.0, 2.0, 1.0, 2.0, 1.0, 1.0))


def at(kind: type[Effect], *places: str) -> Effect:
    return kind.at(places, SCALES)


PULSE, TRAIN, RIPPLE = at(ExternalDisturbance, "knee"), at(ExternalDisturbance, "knee"), at(FreeTorquePeriodic, "knee")
DRY, VISCOUS = at(CoulombFriction, "knee"), at(ViscousDamping, "knee")


@pytest.mark.parametrize(
    ("effects", "expected"),
    [
        ((DRY, VISCOUS), [(DRY, VISCOUS)]),
        # a curve that took up what pulses left of a sine says no more than they do
        ((PULSE, DRY, TRAIN, RIPPLE), [(PULSE, TRAIN, RIPPLE)]),
        ((PULSE, RIPPLE), [(PULSE, RIPPLE)]),
        ((PULSE, DRY), []),
        ((at(FreeFrictionSpeed, "knee"), RIPPLE), []),
        ((DRY, at(ViscousDamping, "hip")), []),
        ((DRY, at(ViscousDamping, "knee", "hip")), []),
    ],
)
def test_effects_of_one_family_at_one_joint_are_of_one_cause(
    effects: Sequence[Effect], expected: Sequence[tuple[Effect, ...]]
) -> None:
    assert of_one_cause(effects) == expected
