"""Rollouts step by step, for what an engine cannot do by itself: servos that hold their torque, laws of terms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.simulation.servo import ServoLaw
from sysid_btr.simulation.setup import Setup, as_ctrl
from sysid_btr.simulation.simulator import States
from sysid_btr.terms.base import Step

Arrays = Callable[[str], Any]
"""Field of MuJoCo -> its (m, ...) array of a simulator, read and written in place."""


def step_through(setup: Setup, borders: IntArray, model: Arrays, data: Arrays, advance: Callable[[], None]) -> States:
    """Roll out by steps of a simulator, between which servos and laws act on its arrays.

    Parameters
    ----------
    setup, borders : as of `Simulator.rollout`.
    model : arrays of compiled fields, with the candidates' numbers in them.
    data : arrays of `qpos`, `qvel`, `ctrl` and `qfrc_applied`, in the initial state; where there are laws also of
        `qfrc_bias` as of the last step, at first zero.
    advance : takes one step of all candidates, from these arrays to these arrays.
    """
    drive = _Drive(setup, model, data)
    qpos, qvel, slot = data("qpos"), data("qvel"), 0
    positions, velocities = (np.empty((len(borders), *x.shape)) for x in (qpos, qvel))
    states = States.empty(setup.size, len(borders), setup.index, effort=setup.effort and drive.alters_torque)
    for k in range(setup.steps + 1):
        kept = slot < len(borders) and borders[slot] == k
        if kept:
            positions[slot], velocities[slot] = qpos, qvel
            slot += 1
        if k == setup.steps:
            break
        drive.act(k)
        if kept and states.effort is not None:
            states.effort[:, slot - 1] = drive.torque()
        advance()
    states.put(setup.index, np.arange(slot), positions.swapaxes(0, 1), velocities.swapaxes(0, 1))
    states.repeat_last_effort()
    return states


class _Drive:
    """Servos, laws of terms and known torques, at each step written into the arrays of a simulator."""

    def __init__(self, setup: Setup, model: Arrays, data: Arrays) -> None:
        self.setup, self.law = setup, ServoLaw.of(setup.batch)
        self.laws = [(law, law.term.start_law(setup.batch, law.values)) for law in setup.laws]
        self.acts = frozenset(name for law in setup.laws for name in law.term.law_acts)
        self.held: FloatArray | None = None
        self.step: Step | None = None
        self.previous: FloatArray | None = None
        index, driven = setup.index, self.law.driven
        self.driven, self.actuators = in_a_row(driven), in_a_row(index.actuator[driven])
        self.dof, self.place = in_a_row(index.dof), in_a_row(index.qpos)
        self.qpos, self.qvel, self.ctrl, self.qfrc = (data(n) for n in ("qpos", "qvel", "ctrl", "qfrc_applied"))
        if self.laws:
            self.load, self.ones = data("qfrc_bias"), np.ones((setup.size, len(index.joints)))
        if "friction" in self.acts:
            self.friction = model("dof_frictionloss")
            self.own_friction = self.friction[:, self.dof].copy()
        if setup.held_steps or "servo" in self.acts:
            self.gain, self.bias = model("actuator_gainprm"), model("actuator_biasprm")
            self.own_gain, self.own_bias = self.gain[:, self.actuators].copy(), self.bias[:, self.actuators].copy()
        if setup.held_steps or "limit" in self.acts:
            self.limited, self.limits = model("actuator_forcelimited"), model("actuator_forcerange")
        if setup.held_steps:
            # the torque is the command, and nothing else
            self.gain[:, self.actuators] = np.eye(1, self.gain.shape[-1])
            self.bias[:, self.actuators] = 0.0
            self.limited[:, self.actuators] = False
            model("actuator_ctrllimited")[:, self.actuators] = False

    @property
    def alters_torque(self) -> bool:
        """Whether the torque of a servo is another than that of its own law in the present state."""
        return bool(self.laws) and (self.setup.held_steps > 0 or not self.acts.isdisjoint({"servo", "limit"}))

    def act(self, k: int) -> None:
        """Write what acts during step k."""
        setup = self.setup
        self.command = command = setup.command[:, k]
        joint_torque = None if setup.applied is None else setup.applied[:, k]
        ticks = setup.held_steps > 0 and k % setup.held_steps == 0
        if self.laws or ticks:
            # not as views: what a step leaves behind is remembered at the next one
            self.q, self.v = self.qpos[:, self.place].copy(), self.qvel[:, self.dof].copy()
        if self.laws:
            self.step = step = self._under_laws(k, command)
            self._write(step)
            joint_torque = step.joint_torque if joint_torque is None else step.joint_torque + joint_torque
        if ticks:
            self.held = self.torque()[:, self.driven] / self.law.gear
        if self.held is None:
            self.ctrl[:, self.actuators] = as_ctrl(setup.index, self.driven, command[:, self.driven])
        else:
            self.ctrl[:, self.actuators] = self.held
        if setup.control is not None:
            self.ctrl[:, setup.index.control] = setup.control[:, k]
        if joint_torque is not None:
            self.qfrc[:, self.dof] = joint_torque

    def torque(self) -> FloatArray:
        """Torque (m, j) of the servos at the start of the present step, under its laws."""
        if self.step is None:
            return self.law.torque(self.command, self.q, self.v)
        step = self.step
        total = step.gain * self.law.unlimited(self.command, self.q, self.v) + step.motor_torque
        return np.minimum(np.maximum(total, step.limit_low), step.limit_high)

    def _under_laws(self, k: int, command: FloatArray) -> Step:
        setup, h = self.setup, self.setup.batch.timestep
        before = self.v if self.previous is None else self.previous
        v_mid = 1.5 * self.v - 0.5 * before
        q_mid = self.q + 0.5 * h * v_mid
        self.previous = self.v
        step = Step(
            time=k * h + 0.5 * h,
            timestep=h,
            command=command,
            qpos=q_mid,
            qvel=v_mid,
            torque=self.law.torque(command, q_mid, v_mid),
            gain=self.ones.copy(),
            motor_torque=np.zeros(self.q.shape),
            joint_torque=np.zeros(self.q.shape),
            friction=np.zeros(self.q.shape),
            limit_low=self.law.low.copy(),
            limit_high=self.law.high.copy(),
            inputs={name: values[k] for name, values in setup.inputs.items()},
            load=self.load[:, self.dof].copy(),
        )
        for law, memory in self.laws:
            law.term.law(step, law.values, memory, law.places)
        return step

    def _write(self, step: Step) -> None:
        """Write what the laws changed."""
        d, actuators, gear = self.driven, self.actuators, self.law.gear
        if "friction" in self.acts:
            self.friction[:, self.dof] = np.maximum(self.own_friction + step.friction, 0.0)
        if self.setup.held_steps:
            return
        if "servo" in self.acts:
            gain = step.gain[:, d, None]
            self.gain[:, actuators] = self.own_gain * gain
            self.bias[:, actuators] = self.own_bias * gain
            self.bias[:, actuators, 0] += step.motor_torque[:, d] / gear
        if "limit" in self.acts:
            # limits are torques at the joint, MuJoCo's are forces before the gear, which may turn the other way
            one, other = step.limit_low[:, d] / gear, step.limit_high[:, d] / gear
            low, high = np.minimum(one, other), np.maximum(one, other)
            finite: BoolArray = np.isfinite(low) | np.isfinite(high)
            self.limited[:, actuators] = finite
            self.limits[:, actuators, 0] = np.where(finite, low, 0.0)
            self.limits[:, actuators, 1] = np.where(finite, high, 0.0)


def in_a_row(index: IntArray) -> IntArray | slice:
    """The same positions as a slice where they follow each other, which is several times faster than by number."""
    first = int(index[0]) if len(index) else 0
    return slice(first, first + len(index)) if np.array_equal(index, first + np.arange(len(index))) else index
