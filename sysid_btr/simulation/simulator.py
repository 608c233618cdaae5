"""What a simulator is, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.simulation.setup import Setup
from sysid_btr.terms.base import JointAddresses


class Simulator(Protocol):
    """Moves candidates of a model.

    What a candidate gets depends on nothing but its own numbers, to the last bit: not on those beside it, not on the
    number of threads. `sysid_btr.testing.check_simulator` has it checked.
    """

    def rollout(self, setup: Setup, borders: IntArray, *, threads: int = 0) -> States:
        """Simulate from the initial states.

        Parameters
        ----------
        setup : the candidates, and what acts on them.
        borders : (k,) borders between steps whose states are wanted, increasing; 0 is the start, and the last one is
            where the rollout ends.
        threads : to use, 0 for all cores.
        """
        ...


@dataclass
class States:
    """States kept at step borders, (m, kept, joints).

    Attributes
    ----------
    position, velocity : as the sensor at the joint sees it, rad or m.
    motor, motor_velocity : at the motor, which is another place where a joint has play or compliance.
    failed : (m,) whether the simulation diverged, so that its states mean nothing.
    effort : torque of the servos in the step that begins at the border; None where it follows from command and state.
    base : (m, kept, 13) of a free base that is recorded: position, quaternion, velocity, angular velocity.
    """

    position: FloatArray
    velocity: FloatArray
    motor: FloatArray
    motor_velocity: FloatArray
    failed: BoolArray
    effort: FloatArray | None = None
    base: FloatArray | None = None

    @classmethod
    def empty(cls, m: int, kept: int, index: JointAddresses, *, effort: bool = False) -> States:
        def new() -> FloatArray:
            return np.empty((m, kept, len(index.joints)))

        motor, motor_velocity = new(), new()
        # without a link side, the sensor sees the motor side
        position, velocity = (new(), new()) if (index.link_qpos >= 0).any() else (motor, motor_velocity)
        base = np.empty((m, kept, 13)) if index.base is not None else None
        failed = np.zeros(m, dtype=bool)
        return cls(position, velocity, motor, motor_velocity, failed, new() if effort else None, base)

    def of(self, rows: slice, slots: IntArray) -> States:
        """Those of some simulations at some of the borders."""
        linked = self.position is not self.motor
        motor, motor_velocity = self.motor[rows][:, slots], self.motor_velocity[rows][:, slots]
        return States(
            self.position[rows][:, slots] if linked else motor,
            self.velocity[rows][:, slots] if linked else motor_velocity,
            motor,
            motor_velocity,
            self.failed[rows],
            None if self.effort is None else self.effort[rows][:, slots],
            None if self.base is None else self.base[rows][:, slots],
        )

    def repeat_last_effort(self) -> None:
        """No step begins at the last border: the servos are taken to do there what they did before."""
        if self.effort is not None:
            self.effort[:, -1] = self.effort[:, -2]

    def put(self, index: JointAddresses, slots: IntArray, qpos: FloatArray, qvel: FloatArray) -> None:
        """Keep the states (m, slots, nq) and (m, slots, nv) in some of the slots."""
        self.motor[:, slots] = qpos[:, :, index.qpos]
        self.motor_velocity[:, slots] = qvel[:, :, index.dof]
        if self.base is not None and index.base is not None:
            place, motion = index.base
            self.base[:, slots, :7] = qpos[:, :, place : place + 7]
            self.base[:, slots, 7:] = qvel[:, :, motion : motion + 6]
        linked = np.flatnonzero(index.link_qpos >= 0)
        if len(linked):
            self.position[:, slots] = self.motor[:, slots]
            self.velocity[:, slots] = self.motor_velocity[:, slots]
            self.position[:, slots[:, None], linked] += qpos[:, :, index.link_qpos[linked]]
            self.velocity[:, slots[:, None], linked] += qvel[:, :, index.link_dof[linked]]
