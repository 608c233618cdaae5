"""An identified model in plain MuJoCo, commanded in units of its joints.

    from sysid_btr.player import Player
    player = Player.load("out")              # model.xml of a finished run
    player.reset({"elbow": 0.1})             # where joints start, rad or m
    player.send({"elbow": 0.4})              # commands by the names of joints, or of actuators in MuJoCo's ctrl
    player.step(0.01)                        # s
    player.positions["elbow"]                # as the encoder shows it

It does what a loop of ``mj_step`` over model.xml would have to do by hand: it finds the actuator of each joint and its
gear, starts buffers of delayed commands and filters at rest, and adds up the two joints of one with backlash or
compliance.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import ModelError, UsageError
from sysid_btr.io.log import Log, with_hint
from sysid_btr.models.commands import FED_FORWARD, commanded
from sysid_btr.mujoco_conventions import FREE
from sysid_btr.result import read_result
from sysid_btr.run_folder import MODEL, RESULT
from sysid_btr.simulation.compiling import make_index
from sysid_btr.simulation.start import initial_state
from sysid_btr.writeback.filed import load_model

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.terms.base import JointAddresses

Values = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Player:
    """A model with its state.

    Attributes
    ----------
    model, data : of MuJoCo, to read and to write as in any script.
    index : where the joints are in it.
    missing : what the run found that is not in the model, in words.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    index: JointAddresses
    missing: tuple[str, ...] = ()

    @classmethod
    def load(cls, source: str | os.PathLike[str], *, fixed_base: bool = False) -> Player:
        """The model of a finished run, from its folder, or any MJCF file.

        Parameters
        ----------
        source : folder with model.xml, or the file.
        fixed_base : whether to remove the free joint, for a robot whose base is fixed.

        Raises
        ------
        UsageError
            If the run has written no model.
        ModelError
            If MuJoCo cannot compile it.
        """
        path = Path(source)
        missing: tuple[str, ...] = ()
        if path.is_dir():
            path, missing = _written(path)
        if not path.is_file():
            raise UsageError(f"{path}: no such file; give the --out folder of a finished run, or its {MODEL}")
        try:
            return cls.of(load_model(path, held=fixed_base), missing)
        except ValueError as error:
            raise ModelError(f"{path}: MuJoCo cannot compile it: {error}") from error

    @classmethod
    def of(cls, model: mujoco.MjModel, missing: tuple[str, ...] = ()) -> Player:
        """A compiled model, such as one of `sysid_btr.model`."""
        import mujoco

        player = cls(model, mujoco.MjData(model), make_index(model), missing)
        player.reset()
        return player

    @property
    def positions(self) -> dict[str, float]:
        """Of every joint, rad or m, as its encoder shows it: with the link side, where that is a joint of its own."""
        return dict(zip(self.index.joints, map(float, self._shown(self.data.qpos, self.index.link_qpos)), strict=True))

    @property
    def velocities(self) -> dict[str, float]:
        """Of every joint, rad/s or m/s."""
        index = self.index
        link = np.where(index.link_dof >= 0, self.data.qvel[index.link_dof], 0.0)
        return dict(zip(index.joints, map(float, self.data.qvel[index.dof] + link), strict=True))

    def _shown(self, values: FloatArray, link: IntArray) -> FloatArray:
        return np.asarray(values[self.index.qpos] + np.where(link >= 0, values[link], 0.0))

    def reset(self, positions: Values | None = None, velocities: Values | None = None) -> None:
        """Start again: joints at the given positions and velocities, else at the model's own and at rest.

        Position servos hold the joints there, and buffers of delayed commands and filters are settled.

        Raises
        ------
        UsageError
            For names that are no joints.
        """
        import mujoco

        mujoco.mj_resetData(self.model, self.data)
        for values, state, address in (
            (positions or {}, self.data.qpos, self.index.qpos),
            (velocities or {}, self.data.qvel, self.index.dof),
        ):
            for name, value in values.items():
                state[address[self._joint(name)]] = value
        self._ease()

    def send(self, commands: Values, *, velocities: Values | None = None, torques: Values | None = None) -> None:
        """Set commands, which hold until the next ones.

        Parameters
        ----------
        commands : by joint, what its drive takes (position, velocity or torque; rad, rad/s, Nm; m, m/s, N), through
            whatever gear; by actuator, MuJoCo's ctrl.
        velocities, torques : fed forward beside positions, by joint, as in torque = kp (q* - q) + kd (v* - v) + tau*.

        Raises
        ------
        UsageError
            For names that nothing drives.
        """
        first = self.data.time == 0
        for name, value in commands.items():
            actuator, scale = self._driven(name)
            self.data.ctrl[actuator] = scale * value
        for name, value in (velocities or {}).items():
            actuator = self._drive(name)
            bias, gear = self.model.actuator_biasprm[actuator], self.model.actuator_gear[actuator, 0]
            self.data.ctrl[actuator] -= bias[2] * gear * value / self.model.actuator_gainprm[actuator, 0]
        for name, value in (torques or {}).items():
            actuator = self._drive(name)
            gear, gain = self.model.actuator_gear[actuator, 0], self.model.actuator_gainprm[actuator, 0]
            self.data.ctrl[actuator] += value / (gear * gain)
        if first:
            self._fill()

    def step(self, seconds: float | None = None) -> None:
        """Simulate one step, or as many as there are in a time."""
        import mujoco

        steps = 1 if seconds is None else max(round(seconds / self.model.opt.timestep), 1)
        for _ in range(steps):
            mujoco.mj_step(self.model, self.data)

    def play(self, log: Log) -> Log:
        """Give the commands of a log to the model, from where its joints were, and record the joints.

        Returns
        -------
        Log
            The same commands and times; position and velocity of every joint of the model.

        Raises
        ------
        UsageError
            If the log has several episodes, or the model has a free base, whose state the log does not hold.
        """
        if len(log.episodes()) > 1:
            raise UsageError("the log has several episodes: play one, such as log.window(0, 500)")
        if np.any(self.model.jnt_type == FREE):
            raise UsageError(
                "the model has a free base: load it with fixed_base=True to play the log of a robot whose base is fixed"
            )
        given, joints = commanded(log, self.model), self.index.joints
        qpos, qvel = initial_state(log, joints, self.model.qpos0[self.index.qpos])
        self.reset(dict(zip(joints, qpos, strict=True)), dict(zip(joints, qvel, strict=True)))
        sources = {channel: given.joints(channel) for channel in ("command", *FED_FORWARD)}
        shown: dict[str, list[float]] = {f"{c}.{j}": [] for c in ("position", "velocity") for j in joints}
        for k, time in enumerate(log.time - log.time[0]):
            while self.data.time < time - 0.5 * self.model.opt.timestep:
                self.step()
            for channel, values in (("position", self.positions), ("velocity", self.velocities)):
                for joint, value in values.items():
                    shown[f"{channel}.{joint}"].append(value)
            now = {
                c: {n: v for n in names if np.isfinite(v := float(given.channels[f"{c}.{n}"][k]))}
                for c, names in sources.items()
            }
            self.send(now["command"], velocities=now[FED_FORWARD[0]], torques=now[FED_FORWARD[1]])
        commands = {name: v for name, v in log.channels.items() if name.partition(".")[0] in ("command", *FED_FORWARD)}
        meta = replace(log.meta, source="played in plain MuJoCo", units={})
        sensors = {name: np.array(values) for name, values in shown.items()}
        return replace(log, channels={**commands, **sensors}, meta=meta, path=None, unknown={})

    def _joint(self, name: str) -> int:
        if name not in self.index.joints:
            raise UsageError(f"the model has no joint {with_hint(name, self.index.joints)}")
        return self.index.joints.index(name)

    def _drive(self, name: str) -> int:
        actuator = int(self.index.actuator[self._joint(name)])
        if actuator < 0:
            raise UsageError(f"no actuator of its own drives joint {name}")
        return actuator

    def _driven(self, name: str) -> tuple[int, float]:
        """Actuator that a command is for, and ctrl per command."""
        if name in self.index.joints:
            return self._drive(name), float(self.index.scale[self._joint(name)])
        names = {self.model.actuator(a).name: a for a in range(self.model.nu)}
        if name not in names:
            raise UsageError(f"the model has no joint or actuator {with_hint(name, (*self.index.joints, *names))}")
        return names[name], 1.0

    def _ease(self) -> None:
        """Position servos hold their joints where they are; others do what the first keyframe says, or nothing."""
        if self.model.nkey:
            self.data.ctrl[:] = self.model.key_ctrl[0]
        for joint, kind in zip(self.index.joints, self.index.drive, strict=True):
            if kind == "position":
                actuator, scale = self._driven(joint)
                self.data.ctrl[actuator] = scale * self.positions[joint]
        self._fill()

    def _fill(self) -> None:
        """Buffers of delayed commands, and filters, as if the present ones had always been."""
        import mujoco

        for a in range(self.model.nu):
            samples = int(self.model.actuator_history[a, 0])
            if samples:
                past = np.full((samples, 1), self.data.ctrl[a])
                mujoco.mj_initCtrlHistory(self.model, self.data, a, None, past)
            filters = (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
            if self.model.actuator_dyntype[a] in filters:
                self.data.act[self.model.actuator_actadr[a]] = self.data.ctrl[a]


def _written(folder: Path) -> tuple[Path, tuple[str, ...]]:
    """The model that a run has written, and what is not in it."""
    if not (folder / RESULT).is_file():
        return folder / MODEL, ()
    written = read_result(folder).get("written") or {"path": None, "why": "runs of this kind write none"}
    if written["path"] is None:
        raise UsageError(f"{folder} holds no {MODEL}: {written['why']}")
    return folder / written["path"], tuple(part["text"] for part in written["not_in_file"])
