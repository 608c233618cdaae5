"""The law of the servos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel


@dataclass(frozen=True, eq=False)
class ServoLaw:
    """Torque of the servos: gear (gain u + constant + stiffness q + damping dq), within limits.

    Computed here because MuJoCo's `actuator_force` lags the state by a substep.

    Attributes
    ----------
    driven : (d,) positions among the joints of those that have a servo; the torque of the others is zero.
    gear, gain, constant, stiffness, damping : (m, d).
    low, high : (m, j) limits of the torque, infinite where there are none.
    """

    driven: IntArray
    gear: FloatArray
    gain: FloatArray
    constant: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, batch: BatchModel, rows: slice = slice(None)) -> ServoLaw:
        """The law in some of the candidates."""
        driven = np.flatnonzero(batch.index.actuator >= 0)
        actuators = batch.index.actuator[driven]
        names = ("gear", "gainprm", "biasprm", "forcerange", "forcelimited")
        gear, gain, bias, forces, limited = (batch.read(f"actuator_{name}")[rows, actuators] for name in names)
        gear = gear[..., 0]
        low, high = (np.full((len(gear), len(batch.index.joints)), infinite) for infinite in (-np.inf, np.inf))
        limits = np.sort(gear[..., None] * forces, axis=-1)
        low[:, driven] = np.where(limited, limits[..., 0], -np.inf)
        high[:, driven] = np.where(limited, limits[..., 1], np.inf)
        return cls(driven, gear, gain[..., 0], bias[..., 0], bias[..., 1] * gear, bias[..., 2] * gear, low, high)

    def unlimited(self, command: FloatArray, qpos: FloatArray, qvel: FloatArray) -> FloatArray:
        """Torque that the servos would like to give; all are (m, j), or (m, samples, j)."""
        every = len(self.driven) == self.low.shape[1]
        u, q, v = (x if every else x[..., self.driven] for x in (command, qpos, qvel))
        numbers = (self.gear, self.gain, self.constant, self.stiffness, self.damping)
        gear, gain, constant, stiffness, damping = numbers if u.ndim == 2 else (x[:, None] for x in numbers)
        own: FloatArray = gain * u
        own += constant
        own += stiffness * q
        own += damping * v
        own *= gear
        if every:
            return own
        torque = np.zeros(np.broadcast_shapes(command.shape, qpos.shape))
        torque[..., self.driven] = own
        return torque

    def torque(self, command: FloatArray, qpos: FloatArray, qvel: FloatArray) -> FloatArray:
        """Torque that the servos give; all are (m, j), or (m, samples, j)."""
        low, high = (self.low, self.high) if command.ndim == 2 else (self.low[:, None], self.high[:, None])
        return np.minimum(np.maximum(self.unlimited(command, qpos, qvel), low), high)
