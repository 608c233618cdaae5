"""How the equations of motion are integrated."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

from sysid_btr.errors import UsageError

MUJOCO = "mujoco"
"""Name of the built-in simulator."""

USUAL = (("simulator", MUJOCO), ("stated", False), ("recorded", False))
"""What files do not say."""
MOST_STEPS = 1e6
"""Steps in a servo's period, beyond any that can be meant."""
LONGEST = 0.1
"""s, of a step."""

INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")
"""MuJoCo's."""


@dataclass(frozen=True)
class Numerics:
    """How the equations are integrated: MuJoCo's integrator by name, and the step in s.

    With `servo_period` (s, a multiple of the step) the servos compute their torque once a period and hold it;
    without, they act as MuJoCo's own do, at every evaluation of the dynamics. `simulator` is the name of what moves the
    model, see `simulation.registry`. `stated` numerics are those in which the model is to be used: they are part of it,
    and nothing refines them. `recorded` ones are those of the MuJoCo that recorded the logs: they too are part of the
    model, with its own settings of the solver.

    Raises
    ------
    ValueError
        If a time is not above zero, or the built-in simulator has no such integrator.
    """

    integrator: str
    timestep: float
    servo_period: float | None = None
    simulator: str = MUJOCO
    stated: bool = False
    recorded: bool = False

    def __post_init__(self) -> None:
        if self.simulator == MUJOCO and self.integrator not in INTEGRATORS:
            raise ValueError(f"{self.integrator!r} is none of the integrators {', '.join(INTEGRATORS)}")
        for seconds in (self.timestep, self.servo_period):
            if seconds is not None and not 0 < seconds < math.inf:
                raise ValueError(f"a step of {seconds} s")
        if self.servo_period is not None and not self.servo_period < MOST_STEPS * self.timestep:
            raise ValueError(f"a servo period of {self.servo_period} s in steps of {self.timestep} s")

    @classmethod
    def parse(cls, text: str) -> Numerics:
        """Stated numerics as ``INTEGRATOR:STEP``, such as ``implicitfast:0.002``.

        Raises
        ------
        UsageError
            If it is not that.
        """
        name, _, step = text.partition(":")
        integrator = {known.casefold(): known for known in INTEGRATORS}.get(name.strip().casefold())
        try:
            seconds = float(step)
        except ValueError:
            seconds = math.nan
        if integrator is None or not 0 < seconds <= LONGEST:
            raise UsageError(
                f"{text!r} is not an integrator and its step: give one of {', '.join(INTEGRATORS)} and seconds up to "
                f"{LONGEST:g}, such as implicitfast:0.002"
            )
        return cls(integrator, seconds, stated=True)

    @property
    def exact(self) -> bool:
        """Whether they are part of the model, so that half the step is no nearer to the truth: those stated, those
        recorded, and an explicit Euler step a period, which is how a digital servo behaves.
        """
        return self.stated or self.recorded or self.integrator == "Euler"

    def halved(self) -> Numerics:
        return replace(self, timestep=self.timestep / 2)

    def to_dict(self) -> dict[str, Any]:
        """As in files: the simulator where it is not the built-in one, and whether they were stated where they were."""
        return {name: value for name, value in asdict(self).items() if (name, value) not in USUAL}

    @property
    def held_steps(self) -> int:
        """Steps for which a servo's torque is held; 0 where it is not."""
        return max(round(self.servo_period / self.timestep), 1) if self.servo_period else 0

    def __str__(self) -> str:
        held = f", servo torque updated every {1e3 * self.servo_period:g} ms" if self.servo_period else ""
        other = "" if self.simulator == MUJOCO else f", simulated by {self.simulator}"
        return f"{self.integrator} {1e3 * self.timestep:g} ms{held}{other}"
