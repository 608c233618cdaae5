"""The law of the servos."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel


@dataclass(frozen=True, eq=False)
class ServoLaw:
    """Torque of the drives: gear (gain u + constant + stiffness q + damping dq), within limits.

    The command u is in units of the joint, and gain is that by which it acts.

    Computed here because MuJoCo's `actuator_force` lags the state by a substep.

    Attributes
    ----------
    driven : (d,) positions among the joints of those that have a drive; the torque of the others is zero.
    gear, gain, constant, stiffness, damping : (m, d).
    least, most : (m, d) commands beyond which the drive does not follow, infinite where there are none.
    low, high : (m, j) limits of the torque, infinite where there are none.
    """

    driven: IntArray
    gear: FloatArray
    gain: FloatArray
    constant: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    least: FloatArray
    most: FloatArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, batch: BatchModel, rows: slice = slice(None)) -> ServoLaw:
        """The law in some of the candidates."""
        driven = np.flatnonzero(batch.index.actuator >= 0)
        actuators = batch.index.actuator[driven]
        names = ("gear", "gainprm", "biasprm", "forcerange", "forcelimited")
        gear, gain, bias, forces, limited = (batch.read(f"actuator_{name}")[rows, actuators] for name in names)
        scale = batch.index.scale[driven]
        gear, gain, constant = gear[..., 0], gain[..., 0] * scale, bias[..., 0]
        controlled = batch.model.actuator_ctrllimited[actuators].astype(bool)
        reach = np.sort(batch.model.actuator_ctrlrange[actuators] / scale[:, None], axis=-1)
        least, most = np.where(controlled, reach[:, 0], -np.inf), np.where(controlled, reach[:, 1], np.inf)
        low, high = (np.full((len(gear), len(batch.index.joints)), infinite) for infinite in (-np.inf, np.inf))
        limits = np.sort(gear[..., None] * forces, axis=-1)
        low[:, driven] = np.where(limited, limits[..., 0], -np.inf)
        high[:, driven] = np.where(limited, limits[..., 1], np.inf)
        stiffness, damping = bias[..., 1] * gear, bias[..., 2] * gear
        return cls(driven, gear, gain, constant, stiffness, damping, least, most, low, high)

    @cached_property
    def _clips(self) -> bool:
        return bool(np.isfinite(self.most).any())

    def unlimited(self, command: FloatArray, qpos: FloatArray, qvel: FloatArray) -> FloatArray:
        """Torque that the servos would like to give; all are (m, j), or (m, samples, j)."""
        every = len(self.driven) == self.low.shape[1]
        u, q, v = (x if every else x[..., self.driven] for x in (command, qpos, qvel))
        numbers = (self.gear, self.gain, self.constant, self.stiffness, self.damping)
        gear, gain, constant, stiffness, damping = numbers if u.ndim == 2 else (x[:, None] for x in numbers)
        own: FloatArray = gain * (np.clip(u, self.least, self.most) if self._clips else u)
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
