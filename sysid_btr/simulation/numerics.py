"""How the equations of motion are integrated."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

MUJOCO = "mujoco"
"""Name of the built-in simulator."""

INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")
"""MuJoCo's."""


@dataclass(frozen=True)
class Numerics:
    """How the equations are integrated: MuJoCo's integrator by name, and the step in s.

    With `servo_period` (s, a multiple of the step) the servos compute their torque once a period and hold it;
    without, they act as MuJoCo's own do, at every evaluation of the dynamics. `simulator` is the name of what moves the
    model, see `simulation.registry`.

    Raises
    ------
    ValueError
        If a time is not above zero, or the built-in simulator has no such integrator.
    """

    integrator: str
    timestep: float
    servo_period: float | None = None
    simulator: str = MUJOCO

    def __post_init__(self) -> None:
        if self.simulator == MUJOCO and self.integrator not in INTEGRATORS:
            raise ValueError(f"{self.integrator!r} is none of the integrators {', '.join(INTEGRATORS)}")
        for seconds in (self.timestep, self.servo_period):
            if seconds is not None and not 0 < seconds < math.inf:
                raise ValueError(f"a step of {seconds} s")

    def halved(self) -> Numerics:
        return replace(self, timestep=self.timestep / 2)

    def to_dict(self) -> dict[str, Any]:
        """As in files: the simulator where it is not the built-in one."""
        return {name: value for name, value in asdict(self).items() if (name, value) != ("simulator", MUJOCO)}

    @property
    def held_steps(self) -> int:
        """Steps for which a servo's torque is held; 0 where it is not."""
        return max(round(self.servo_period / self.timestep), 1) if self.servo_period else 0

    def __str__(self) -> str:
        held = f", servo torque updated every {1e3 * self.servo_period:g} ms" if self.servo_period else ""
        other = "" if self.simulator == MUJOCO else f", simulated by {self.simulator}"
        return f"{self.integrator} {1e3 * self.timestep:g} ms{held}{other}"
