"""Episodes whose torques are predicted from their measured motion: no command is needed, and nothing diverges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.errors import LogError, ModelError
from sysid_btr.identify.episode import Episode, Procedure
from sysid_btr.io.log import Log
from sysid_btr.io.noise import NoiseFloor, channel_noise
from sysid_btr.models.pose import resting
from sysid_btr.models.robot import Robot, joint_names
from sysid_btr.objectives.problem import Comparison
from sysid_btr.simulation.compiling import make_index
from sysid_btr.simulation.inverse import InverseReplay, needs_history
from sysid_btr.simulation.kinematics import Kinematics, low_pass, smooth, uniform
from sysid_btr.simulation.numerics import MUJOCO, Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.base import Outputs, Term

_CASED = {"EULER": "Euler", "RK4": "RK4"}
DRAWS = 4
"""Of the positions' noise, whose effect on the predicted torques is measured."""


class InverseProcedure(Procedure):
    """How a fit goes about torques of a measured motion: nothing is integrated, so no step needs refining."""

    refines_step: ClassVar[bool] = False
    replayed: ClassVar[bool] = False
    no_torque: ClassVar[str] = "too little of it moves"
    unseen: ClassVar[str] = (
        "torques are compared sample by sample with those of the measured motion, in which this changes nothing. "
        "Leave it out, or replay commands: --mode forward"
    )

    def shows(self, term: type[Term]) -> bool:
        """Samples are compared one by one: what needs a past, or a joint of its own, does nothing there."""
        return not needs_history(term)


@dataclass(frozen=True, eq=False)
class InverseEpisode(Episode):
    """An episode whose torques are compared with those that its motion takes.

    `recording` and `log` are on the uniform grid of the motion, with filtered torques.

    Attributes
    ----------
    kinematics : motion, sample by sample of `recording`.
    noise : joint -> standard deviation of its torque's error where the model is right: the sensor's in the band that is
        compared, and what the positions' noise makes of the prediction.
    """

    kinematics: Kinematics
    noise: Mapping[str, float]

    @property
    def procedure(self) -> Procedure:
        return InverseProcedure()

    @classmethod
    def whole(cls, robot: Robot, log: Log, threads: int = 0) -> Self:
        """All of a recording.

        Raises
        ------
        LogError, ModelError
            If the log has no torques or too little motion.
        """
        joints = joint_names(robot)
        torques = tuple(j for j in joints if log.has("effort", j))
        if not torques:
            raise ModelError(
                f"log {log.path or ''}: inverse dynamics compare torques, and it has no effort of the model's joints. "
                "Log effort.<joint> (Nm or N), or replay its commands: --mode forward"
            )
        configured = robot.for_log(log)
        index = make_index(configured.model)
        sigma = np.array([_sigma(log, f"position.{joint}") for joint in index.joints])
        motion = smooth(log, index.joints, resting(configured, log, index.joints), sigma)
        _, period, raw = uniform(log, tuple(f"effort.{j}" for j in torques))
        together = round(motion.period / period)
        effort = low_pass(raw, motion.cutoff, period)[::together]
        channels = {f"position.{j}": motion.position[:, i] for i, j in enumerate(index.joints)}
        channels |= {f"velocity.{j}": motion.velocity[:, i] for i, j in enumerate(index.joints)}
        channels |= {f"effort.{j}": effort[:, k] for k, j in enumerate(torques)}
        recording = Log(
            motion.time,
            channels,
            replace(log.meta, sample_period=motion.period),
            np.zeros(len(motion.time), dtype=np.int64),
            log.path,
        )
        scored = np.ones(len(recording), dtype=bool)
        band = min(2 * motion.cutoff * period, 1.0)
        own = {j: _sigma(log, f"effort.{j}") * float(np.sqrt(band)) for j in torques}
        bare = cls(robot, recording, scored, motion, own)
        return replace(bare, noise=bare._with_noise_of_motion(log, sigma, own, threads))

    @property
    def compared(self) -> BoolArray:
        """(n,) samples that count: those that tell something new, and in which no end of the filter shows."""
        motion, log = self.kinematics, self.log
        rows = np.arange(len(log))
        time = motion.time[: len(log)]
        inside = (time >= motion.settled) & (time <= time[-1] - motion.settled)
        return np.asarray(self.scored[: len(log)] & inside & (rows % motion.every == 0))

    def logged(self, channels: Sequence[str]) -> tuple[str, ...]:
        return tuple(c for c in channels if c == "effort")

    def predicts_torque(self, replay: Replay) -> BoolArray:
        return np.ones(len(replay.index.joints), dtype=bool)

    def replay(
        self, terms: Sequence[Term], numerics: Numerics, *, effort: bool = False, threads: int = 0
    ) -> InverseReplay:
        log = self.log
        return InverseReplay(
            self.robot.for_log(log),
            log,
            tuple(terms),
            numerics,
            True,
            threads,
            kinematics=self.kinematics.rows(0, len(log)),
        )

    def completed(self, plain: Comparison) -> Comparison:
        moving = self.kinematics.moving[: len(self.log)]
        targets = []
        for target in plain.targets:
            noise = np.array([self.noise[j] for j in target.joints])
            floor = tuple(
                NoiseFloor(float(s), "high-frequency", f.step) for s, f in zip(noise, target.floor, strict=True)
            )
            inflated = target.sigma / target.noise
            mask = target.mask & moving[:, target.columns]
            targets.append(replace(target, floor=floor, sigma=noise * inflated, mask=mask))
        if not any(target.mask.any() for target in targets):
            end = float(self.log.time[-1] - self.log.time[0])
            raise LogError(
                f"log {self.log.path or ''}: no joint with a torque moves between {self.begin:.3g} and {end:.3g} s, "
                "and torques of joints that stand still are not compared: dry friction takes any value in them. Give "
                "a part of the log in which they move"
            )
        return replace(plain, targets=tuple(targets))

    def torque_at_hand(self, outputs: Outputs) -> FloatArray:
        assert outputs.effort is not None
        torque: FloatArray = outputs.effort[0].copy()
        for i, joint in enumerate(joint_names(self.robot)):
            if self.log.has("effort", joint):
                torque[:, i] = self.log.channels[f"effort.{joint}"]
        return torque

    def shortened(self, seconds: float) -> Self:
        return self

    def swinging(self, threads: int = 0) -> tuple[str, ...]:
        """Joints whose measured torque is less than the inertia of the plain model takes: their weight moves them.

        The torque is then a small difference of inertia and weight. Errors of the accelerations are not small beside
        it, and regression shrinks every number (Janot, Vandanjon and Gautier 2014, doi:10.1109/TCST.2013.2246163). On
        industrial arms that follow a path it is 2 to 60 times the inertia's, in seven of eight logs of a double
        pendulum that swings 0.02 to 0.6 of it.
        """
        replay = self.replay((), Numerics("RK4", self.kinematics.period), threads=threads)
        steady = replace(self.kinematics, acceleration=0 * self.kinematics.acceleration)
        inertia = (_efforts(replay) - _efforts(replace(replay, kinematics=steady)))[self.compared]
        torque = np.column_stack([self.log.channels[f"effort.{j}"] for j in self.noise])[self.compared]
        taken = inertia[:, [replay.index.joints.index(j) for j in self.noise]]
        less = np.mean(torque**2, axis=0) < np.mean(taken**2, axis=0)
        return tuple(j for j, swings in zip(self.noise, less, strict=True) if swings)

    def choose_numerics(self, threads: int = 0, simulator: str = MUJOCO) -> tuple[Numerics, float]:
        """Nothing is integrated: those of the model."""
        import mujoco

        options = self.robot.model.opt
        name = mujoco.mjtIntegrator(int(options.integrator)).name.removeprefix("mjINT_")
        return Numerics(_CASED.get(name, name.lower()), float(options.timestep), simulator=simulator), 0.0

    def facts(self) -> Mapping[str, Any]:
        motion = self.kinematics
        return {
            "mode": "inverse",
            "why": self.why,
            "summary": f"inverse dynamics: {int(self.compared.sum())} instants compared, torques of the "
            f"measured motion below {motion.cutoff:.3g} Hz",
            "motion_band_hz": motion.band,
            "torque_band_hz": float(motion.cutoff) if np.isfinite(motion.cutoff) else None,
            "samples": int(self.compared.sum()),
            "noise": dict(self.noise),
        }

    def _with_noise_of_motion(
        self, log: Log, sigma: FloatArray, own: Mapping[str, float], threads: int
    ) -> Mapping[str, float]:
        """Standard deviations of the torques' errors, those that come from noisy positions included."""
        replay = self.replay((), Numerics("RK4", self.kinematics.period), threads=threads)
        right = _efforts(replay)
        square = np.zeros(right.shape[1])
        rng = np.random.default_rng(0)
        for _ in range(DRAWS):
            channels = dict(log.channels)
            for i, joint in enumerate(replay.index.joints):
                if log.has("position", joint):
                    channels[f"position.{joint}"] = channels[f"position.{joint}"] + sigma[i] * rng.normal(size=len(log))
            start = resting(replay.robot, log, replay.index.joints)
            noisy = smooth(replace(log, channels=channels), replay.index.joints, start, sigma, self.kinematics.band)
            error = _efforts(replace(replay, kinematics=noisy)) - right
            square += np.mean(error**2, axis=0) / DRAWS
        return {j: float(np.hypot(s, np.sqrt(square[replay.index.joints.index(j)]))) for j, s in own.items()}


def _efforts(replay: InverseReplay) -> FloatArray:
    outputs = replay.predict(np.zeros((1, 0)))
    assert outputs.effort is not None
    return np.asarray(outputs.effort[0])


def _sigma(log: Log, column: str) -> float:
    """Standard deviation of a column's noise; nothing of one that is not logged."""
    return channel_noise(log, column).sigma if column in log.channels else 0.0
