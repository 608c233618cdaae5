"""How large a robot is, and how fast it therefore walks: lengths and times of one robot as those of another.

Legs of length l under gravity g walk alike in units of l and sqrt(l / g) (Alexander and Jayes 1983,
doi:10.1111/j.1469-7998.1983.tb04266.x). Thresholds of a floating base were set on the Nao, so they are stated in its
metres and seconds, and turned into those of the robot at hand. What belongs to sensors, clocks and buses stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import ModelError
from sysid_btr.floating_base.feet import base_body, touching_bodies, up_to_base

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class BodySize:
    """What sets the lengths, times and forces of a robot that walks.

    Attributes
    ----------
    leg : m, from the base's origin along the bodies of the longest leg to its outermost point that can touch the
        ground; the same in every pose.
    gravity : m/s2.
    weight : N, of all of it.
    """

    leg: float
    gravity: float
    weight: float

    def length(self, nao: float) -> float:
        """m, of what is `nao` m on the Nao."""
        return nao * (self.leg / NAO.leg)

    def acceleration(self, nao: float) -> float:
        """m/s2, of what is `nao` m/s2 on the Nao."""
        return nao * (self.gravity / NAO.gravity)

    def time(self, nao: float) -> float:
        """s, of what is `nao` s on the Nao."""
        return nao * float(np.sqrt(self.length(1.0) / self.acceleration(1.0)))

    def speed(self, nao: float) -> float:
        """m/s, of what is `nao` m/s on the Nao."""
        return nao * (self.length(1.0) / self.time(1.0))

    def state(self, nao: Sequence[float]) -> FloatArray:
        """(6,) of a base's position, rotation, velocity and angular velocity, and of a hinge's angle and velocity."""
        units = (self.length(1.0), 1.0, self.speed(1.0), 1 / self.time(1.0), 1.0, 1 / self.time(1.0))
        return np.multiply(nao, units)


NAO = BodySize(leg=0.44517271608627274, gravity=9.81, weight=9.81 * 4.34)
"""``nao:table1``."""


def measure_size(model: mujoco.MjModel) -> BodySize:
    """The size of a compiled model with a free base.

    Raises
    ------
    ModelError
        If it has no weight: nothing falls into steps.
    """
    import mujoco

    base = base_body(model)
    reach = [0.0]
    for foot in touching_bodies(model):
        body = model.body(foot.name).id
        along = () if body == base else up_to_base(model, body)
        outermost = float((np.linalg.norm(foot.points, axis=1) + foot.radius).max())
        reach.append(sum(float(np.linalg.norm(model.body_pos[b])) for b in along) + outermost)
    gravity = float(np.linalg.norm(model.opt.gravity))
    weight = gravity * float(mujoco.mj_getTotalmass(model))
    if not weight > 0:
        raise ModelError("the log is a floating-base log, and the model has no weight: give it gravity and masses")
    return BodySize(max(reach), gravity, weight)
