"""Choosing the integrator and the step by a convergence check on the log at hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import ModelError
from sysid_btr.io.noise import channel_noise
from sysid_btr.models.robot import Robot
from sysid_btr.simulation.base_states import BaseStates
from sysid_btr.simulation.numerics import MUJOCO, Numerics
from sysid_btr.simulation.replay import Replay

if TYPE_CHECKING:
    from sysid_btr.io.log import Log

PAPER_TIMING = Numerics("Euler", 0.055 / 7)
"""Timing of the Back-to-Reality paper: seven steps between references that come every 55 ms."""
COARSEST = 0.010
FINEST = 0.00025
TOLERATED = 0.02
"""Root-mean-square change under half the step, in noise floors, at which a step is fine enough.

Small against the noise of one sample is not small against what thousands of samples average to, so this
is followed by a check of the fitted parameters themselves (`identify.check_numerics`).
"""
TOLERATED_ON_GROUND = 0.05
"""The same of a robot that stands: where soles touch, errors hardly fall with the step. Of a simulated humanoid 5 ms
leave 0.04 at the ankles and 0.006 at the arms, 1.25 ms 0.01 and 0.001 at four times the cost."""
CHECK_SECONDS = 4.0
"""Part of a log over which steps are compared. Of 25 logs of eight robots (hanging Naos, legs, pendulums, arms,
measured servos with a jittering clock) each gets the same step by 12, 6 and 3 s."""
BEGUN = 0.02
"""Fraction of its largest distance from its first sample beyond which a joint moves."""


def choose_numerics(
    robot: Robot, log: Log, threads: int = 0, simulator: str = MUJOCO, base: BaseStates | None = None
) -> tuple[Numerics, float]:
    """Integrator and step for a log, and the change in noise floors when the step is halved.

    A log that states its servo's period is replayed by one explicit Euler step a period, which is how a servo
    behaves that reads its velocity from differences of position; `held_numerics` is the alternative.
    Otherwise fourth-order Runge-Kutta, at the largest step that divides the sample period and passes the
    check. `base` is the state from which a free base starts, of a robot that stands.

    Raises
    ------
    ModelError
        If the plain model diverges at every step.
    """
    if log.meta.servo_period:
        return Numerics("Euler", float(log.meta.servo_period), simulator=simulator), float("nan")
    part = replace(Beginning.of(log), base=base)
    tolerated = TOLERATED if base is None else TOLERATED_ON_GROUND
    start = largest_step(log, simulator)
    chosen, error = converged(start, lambda n: part.positions(robot, n, threads), part.log, tolerated)
    if not np.isfinite(error):
        raise ModelError(
            f"model {robot.name}: the replay of {log.path or 'the log'} diverges even with a step of "
            f"{1e3 * chosen.timestep:g} ms. Check gains, armature and masses of the model: a servo far too stiff "
            "for its inertia, or a body without mass, is the usual cause."
        )
    return chosen, error


def largest_step(log: Log, simulator: str = MUJOCO) -> Numerics:
    """Fourth-order Runge-Kutta at the largest step that divides the sample period."""
    return Numerics("RK4", _divisor(float(np.median(np.diff(log.time))), COARSEST), simulator=simulator)


def converged(
    chosen: Numerics, moved: Callable[[Numerics], dict[str, FloatArray]], log: Log, tolerated: float = TOLERATED
) -> tuple[Numerics, float]:
    """The largest step, beginning with one, that passes the check, and the change when it is halved.

    Parameters
    ----------
    chosen : integrator and step to begin with.
    moved : joint -> positions (n,) in the plain model under some numerics.
    log : whose noise floors are the measure.
    tolerated : change at which a step is fine enough; `TOLERATED` unless told.

    Returns
    -------
    Numerics, float
        The finest step where none passes; the change is not finite where even that diverges.
    """
    now = moved(chosen)
    while True:
        half = moved(chosen.halved())
        error = _change(log, now, half)
        if error <= tolerated or chosen.timestep / 2 < FINEST:
            return chosen, error
        chosen, now = chosen.halved(), half


def held_numerics(robot: Robot, log: Log, threads: int = 0, simulator: str = MUJOCO) -> Numerics | None:
    """One Runge-Kutta step a period of the log's servo, under a servo torque that is held for it.

    Exact, in steps as short as `converged` finds, for a servo that knows its velocity. None where the log states no
    period, or where an explicit Euler step a period, which is cheaper, does the same.
    """
    if not log.meta.servo_period:
        return None
    period = float(log.meta.servo_period)
    held = Numerics("RK4", period, period, simulator)
    euler = replace(held, integrator="Euler", servo_period=None)
    part = Beginning.of(log)
    coarse, fine = (part.positions(robot, n, threads) for n in (euler, held))
    return None if _change(part.log, coarse, fine) <= TOLERATED else held


@dataclass(frozen=True, eq=False)
class Beginning:
    """The beginning of a log, in which steps are compared.

    Attributes
    ----------
    log : until so many seconds after its joints begin to move.
    begun : sample at which they do: at rest every step would do.
    base : state from which a free base starts; None for the model's own.
    """

    log: Log
    begun: int
    base: BaseStates | None = None

    @classmethod
    def of(cls, log: Log, seconds: float = CHECK_SECONDS) -> Beginning:
        """Of a log, with so many seconds of motion."""
        begun = len(log) - 1
        for joint in log.joints("position"):
            away = np.abs(log.channels[f"position.{joint}"] - log.channels[f"position.{joint}"][0])
            if np.any(away > 0):
                begun = min(begun, int(np.argmax(away > BEGUN * np.nanmax(away))))
        stop = max(int(np.searchsorted(log.time, log.time[begun] + seconds)), begun + 1, 2)
        return cls(log.window(0, stop), begun)

    def positions(self, robot: Robot, numerics: Numerics, threads: int) -> dict[str, FloatArray]:
        """Joint -> positions (n,) of a replay of the plain model, from where joints move."""
        log = self.log
        replay = Replay(robot.for_log(log), log, (), numerics, threads=threads, base_start=self.base)
        seen = replay.predict(np.zeros((1, 0))).position[0, self.begun :]
        return {j: seen[:, i] for i, j in enumerate(replay.index.joints) if log.has("position", j)}


def _divisor(sample: float, most: float) -> float:
    """Largest step, at most `most`, that divides the sample period."""
    return sample / max(int(np.ceil(sample / most - 1e-9)), 1)


def _change(log: Log, coarse: dict[str, FloatArray], fine: dict[str, FloatArray]) -> float:
    worst = []
    for joint, values in fine.items():
        sigma = channel_noise(log, f"position.{joint}").sigma
        worst.append(np.sqrt(np.mean((values - coarse[joint]) ** 2)) / sigma)
    return float(np.max(worst)) if worst else 0.0
