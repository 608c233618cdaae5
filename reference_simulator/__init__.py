"""Robot logs from another rigid-body engine than the one that fits them.

Pinocchio computes the dynamics; integrator, servo, friction, backlash and everything else are this package's
own, so that a fit to such a log is no inverse crime. Development only: needs `pip install pin`. See README.md
beside this file.
"""

from reference_simulator.effects import EFFECTS, parse_effect
from reference_simulator.forms import FORMS
from reference_simulator.motions import MOTIONS
from reference_simulator.record import Follow, Recording, Sensors, exact_channels, record, save
from reference_simulator.robot import load_robot

__all__ = [
    "EFFECTS",
    "FORMS",
    "MOTIONS",
    "Follow",
    "Recording",
    "Sensors",
    "exact_channels",
    "load_robot",
    "parse_effect",
    "record",
    "save",
]
