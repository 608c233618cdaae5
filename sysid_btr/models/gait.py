"""An open-loop walk for Nao: commands of all joints as a function of time and of four numbers.

The centre of mass sways as a linear inverted pendulum whose zero-moment point moves sinusoidally between the feet
(Kajita et al. 2003, doi:10.1109/ROBOT.2003.1241826); each foot is lifted while the weight is on the other one, and
swung forward. Soles and torso stay level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.interpolation import smooth_step

THIGH, KNEE_FORWARD, SHANK = 0.12, 0.005, 0.10
"""m, of the leg: knee below and in front of the hip, ankle below the knee."""
PENDULUM = 0.26
"""m, height of the centre of mass above the ground."""
GRAVITY = 9.81
SETTLE = 1.0
"""s of standing before the first step."""


@dataclass(frozen=True)
class Gait:
    """Parameters of a walk.

    Attributes
    ----------
    step_length : by which each foot lands in front of the other, m; negative walks backwards.
    step_height : by which the swinging foot is lifted, m.
    period : of two steps, s.
    sway : amplitude of the zero-moment point to the sides, m; the feet's middles are 0.055 m from the centre.
    crouch : by which the hips are lowered from straight legs, m.
    lean : of the feet behind the hips, m; puts the centre of mass over the soles' middle.
    """

    step_length: float = 0.02
    step_height: float = 0.015
    period: float = 1.0
    sway: float = 0.05
    crouch: float = 0.015
    lean: float = 0.0

    def __post_init__(self) -> None:
        if not self.period > 0.2:
            raise UsageError(f"gait: the period of two steps must be above 0.2 s, not {self.period}")
        if not 0.002 <= self.crouch <= 0.12:
            raise UsageError(f"gait: the crouch must lie between 0.002 and 0.12 m, not {self.crouch}")
        if self.step_height < 0 or self.sway < 0:
            raise UsageError("gait: step height and sway cannot be negative")


ARMS = {
    "HeadYaw": 0.0,
    "HeadPitch": 0.0,
    "RShoulderPitch": 1.4,
    "LShoulderPitch": 1.4,
    "RShoulderRoll": -0.15,
    "LShoulderRoll": 0.15,
    "RElbowYaw": 0.0,
    "LElbowYaw": 0.0,
    "RElbowRoll": 0.05,
    "LElbowRoll": -0.05,
}
"""rad, of the joints that do not walk."""


def gait(parameters: Gait, time: FloatArray) -> dict[str, FloatArray]:
    """Commands of a walk.

    Parameters
    ----------
    parameters : of the walk.
    time : (n,) s since its start.

    Returns
    -------
    dict
        Joint name -> (n,) command, rad, for all 22 joints of ``nao``.

    Raises
    ------
    UsageError
        If the legs are too short for it.
    """
    time = np.asarray(time, dtype=np.float64)
    frequency = 2 * np.pi / parameters.period
    # a sinusoidal zero-moment point p needs a centre of mass y with p = y - y'' h / g
    amplitude = parameters.sway / (1 + frequency**2 * PENDULUM / GRAVITY)
    angle = frequency * np.maximum(time - SETTLE, 0.0)
    fade = smooth_step((time - SETTLE) / (1.5 * parameters.period))
    sideways = fade * amplitude * np.sin(angle)
    # how far a foot is through its stance (0 at landing, 1 at lift-off) or swing, from the phase of the sway
    commands = {name: np.full(len(time), value) for name, value in ARMS.items()}
    for side, sign in (("L", 1.0), ("R", -1.0)):
        # the left foot swings around the moment at which the body is farthest to the right
        phase = np.mod(angle / (2 * np.pi) - (0.75 if sign > 0 else 0.25) + 0.5, 1.0) - 0.5
        swing = np.clip(phase / SWING + 0.5, 0.0, 1.0)
        flying = np.abs(phase) < SWING / 2
        lift = np.where(flying, 0.5 * (1 - np.cos(2 * np.pi * swing)), 0.0)
        stance = np.mod(phase - SWING / 2, 1.0) / (1 - SWING)
        forward = np.where(flying, -np.cos(np.pi * swing) / 2, 0.5 - stance)
        x = fade * parameters.step_length * forward - parameters.lean
        z = -(THIGH + SHANK - parameters.crouch) + fade * parameters.step_height * lift
        for joint, values in leg_angles(x, -sideways, z).items():
            commands[side + joint] = values
    return commands


SWING = 0.3
"""Fraction of the period for which a foot is in the air."""


def leg_angles(x: FloatArray, y: FloatArray, z: FloatArray) -> dict[str, FloatArray]:
    """Joint angles that put an ankle at (x, y, z) m from its hip (forward, left, up) with a level sole.

    Raises
    ------
    UsageError
        If a leg cannot reach that far.
    """
    x, y, z = np.broadcast_arrays(x, y, z)
    upper, skew = np.hypot(THIGH, KNEE_FORWARD), np.arctan2(KNEE_FORWARD, THIGH)
    down = np.hypot(y, z)
    reach = np.hypot(x, down)
    if np.any(reach >= upper + SHANK) or np.any(reach <= upper - SHANK):
        raise UsageError(
            f"gait: the feet would be {reach.min():.3f} to {reach.max():.3f} m from the hips, but a leg reaches "
            f"{upper + SHANK:.3f} m: take shorter steps, sway less or crouch more"
        )
    knee = np.pi - skew - np.arccos((upper**2 + SHANK**2 - reach**2) / (2 * upper * SHANK))
    ahead = np.arctan2(x, down) + np.arccos((upper**2 + reach**2 - SHANK**2) / (2 * upper * reach))
    hip = skew - ahead
    roll = np.arctan2(y, -z)
    return {
        "HipYawPitch": np.zeros_like(knee),
        "HipRoll": roll,
        "HipPitch": hip,
        "KneePitch": knee,
        "AnklePitch": -hip - knee,
        "AnkleRoll": -roll,
    }
