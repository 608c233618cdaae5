"""What motion is asked for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MotionSettings:
    """Length, sampling and limits of a motion.

    Attributes
    ----------
    seconds, rate : length (s) and sampling (Hz).
    joints : globs of the joints that shall move; none: all with a servo.
    margin : fraction of each joint's range that is left free at either end, below one half: servos overshoot.
    velocity, acceleration : rad/s (m/s) and rad/s^2 (m/s^2) of every joint; None for those of `excite.motion`.
    """

    seconds: float = 10.0
    rate: float = 100.0
    joints: tuple[str, ...] = ()
    margin: float = 0.05
    velocity: float | None = None
    acceleration: float | None = None
