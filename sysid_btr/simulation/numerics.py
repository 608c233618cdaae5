"""How the equations of motion are integrated."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Numerics:
    """How the equations are integrated: MuJoCo's integrator by name, and the step in s.

    With `servo_period` (s, a multiple of the step) the servos compute their torque once a period and hold it;
    without, they act as MuJoCo's own do, at every evaluation of the dynamics.
    """

    integrator: str
    timestep: float
    servo_period: float | None = None

    def halved(self) -> Numerics:
        return Numerics(self.integrator, self.timestep / 2, self.servo_period)

    @property
    def held_steps(self) -> int:
        """Steps for which a servo's torque is held; 0 where it is not."""
        return max(round(self.servo_period / self.timestep), 1) if self.servo_period else 0

    def __str__(self) -> str:
        held = f", servo torque updated every {1e3 * self.servo_period:g} ms" if self.servo_period else ""
        return f"{self.integrator} {1e3 * self.timestep:g} ms{held}"
