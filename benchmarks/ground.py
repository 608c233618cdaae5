"""`python -m benchmarks.ground`: do intervals from walks hold where the ground is not the model's?

A Nao of other masses and gains walks on springs and dampers under the corners of its feet, with regularised friction:
no constraint solver, as MuJoCo has one. Masses of legs and arms, kp, kv and the model's own contact are fitted. Walks
are drawn by number and kept in the table when they are done, so that the study can be stopped and goes on where it was.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchmarks.walks import INERTIAL
from sysid_btr.identify.fit import fit
from sysid_btr.identify.mode import Mode
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.gait import Gait, gait

if TYPE_CHECKING:
    from numpy.random import Generator

RESULTS = Path(__file__).parent / "results" / "ground.csv"
BODIES = ("KneePitch", "HipPitch", "HipRoll", "ShoulderRoll")
PERIOD, STEP, TICK = 0.02, 5e-4, 2 * np.pi / 4096
CONTACT = ("foot_compliance:*AnkleRoll=shared", "foot_friction:*AnkleRoll=shared")
SECONDS = 12.0
UPRIGHT = 0.4
"""rad, tilt beyond which a robot has fallen; another one is drawn."""


@dataclass(frozen=True)
class Ground:
    """Springs under the corners of the feet.

    Attributes
    ----------
    stiffness : N/m of a corner.
    damping : by which the normal force falls with speed, over `stiffness` times depth, at 0.05 m/s upwards.
    friction, creep : coefficient, and speed (m/s) at which 0.7 of it is reached.
    """

    stiffness: float
    damping: float
    friction: float
    creep: float


@dataclass(frozen=True)
class Walker:
    """What is hidden from the fit."""

    gait: Gait
    ground: Ground
    masses: Mapping[str, float]
    kp: float
    kv: float
    arms: float
    seed: int


def draw(seed: int) -> Walker:
    """A walker by number."""
    rng = np.random.default_rng([17, seed])
    return Walker(
        gait=Gait(
            period=float(rng.choice([0.8, 1.0, 1.2, 2.0, 2.4])),
            step_length=float(rng.choice([-0.01, 0.01, 0.02, 0.03])),
            step_height=float(rng.uniform(0.01, 0.02)),
            sway=float(rng.uniform(0.045, 0.055)),
        ),
        ground=Ground(
            stiffness=float(10 ** rng.uniform(3.8, 4.5)),
            damping=float(rng.uniform(0.2, 0.8)),
            friction=float(rng.uniform(0.6, 0.9)),
            creep=float(rng.choice([0.005, 0.01, 0.02])),
        ),
        masses={side + body: float(rng.uniform(0.75, 1.3)) for body in BODIES for side in "RL"},
        kp=float(rng.uniform(0.9, 1.1)),
        kv=float(rng.uniform(0.85, 1.15)),
        arms=float(rng.uniform(0.1, 0.3)),
        seed=seed,
    )


def record(walker: Walker) -> Log | None:
    """What the sensors of a walker show; None if it falls."""
    import mujoco

    spec = load_robot("nao").make_spec()
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4
    for name, factor in walker.masses.items():
        next(g for g in spec.body(name).geoms if g.mass > 0).mass *= factor
    model = spec.compile()
    data = mujoco.MjData(model)
    model.actuator_gainprm[:, 0] *= walker.kp
    model.actuator_biasprm[:, 1] *= walker.kp
    model.actuator_biasprm[:, 2] *= walker.kv
    model.geom_contype[:] = model.geom_conaffinity[:] = 0
    joints = tuple(model.actuator(i).name for i in range(model.nu))
    address = [model.jnt_qposadr[model.joint(j).id] for j in joints]
    time = np.arange(0, SECONDS - 1e-9, PERIOD)
    commands = commands_of(walker, time, joints)
    feet = _Feet(model, walker.ground)
    mujoco.set_mjcb_passive(feet.push)
    try:
        data.qpos[address] = commands[0]
        mujoco.mj_forward(model, data)
        data.qpos[2] -= feet.lowest(data)
        rows = []
        for command in commands:
            mujoco.mj_forward(model, data)
            turn = data.body("Torso").xmat.reshape(3, 3)
            if np.arccos(np.clip(turn[2, 2], -1, 1)) > UPRIGHT:
                return None
            angles = np.arctan2(turn[2, 1], turn[2, 2]), -np.arcsin(turn[2, 0])
            sensors = [data.sensor(name).data.copy() for name in ("gyro", "acc")]
            rows.append(np.concatenate([data.qpos[address], *sensors, angles, feet.load]))
            data.ctrl[:] = command
            mujoco.mj_step(model, data, round(PERIOD / STEP))
    finally:
        mujoco.set_mjcb_passive(None)
    return _log(model, time, joints, commands, np.array(rows), np.random.default_rng([18, walker.seed]))


def commands_of(walker: Walker, time: np.ndarray[Any, Any], joints: Sequence[str]) -> np.ndarray[Any, Any]:
    """The gait, with arms that swing: (n, joints)."""
    found = dict(gait(walker.gait, time))
    fade = np.clip(time - 0.5, 0, 1) * walker.arms
    for side, sign, phase in (("R", 1, 0.0), ("L", -1, np.pi)):
        turn = 2 * np.pi * time / walker.gait.period + phase
        found[f"{side}ShoulderPitch"] = found[f"{side}ShoulderPitch"] + fade * np.sin(turn)
        found[f"{side}ElbowRoll"] = found[f"{side}ElbowRoll"] + sign * 0.5 * fade * (1 - np.cos(turn))
        found[f"{side}ShoulderRoll"] = found[f"{side}ShoulderRoll"] - sign * 0.4 * fade * (1 - np.cos(2 * turn))
    return np.stack([found[j] for j in joints], axis=1)


class _Feet:
    """Forces of the ground, as MuJoCo's callback for passive forces."""

    def __init__(self, model: Any, ground: Ground) -> None:
        self.ground = ground
        self.bodies = [model.body(f"{side}AnkleRoll").id for side in "LR"]
        self.corners = []
        for body in self.bodies:
            geom = int(np.flatnonzero(model.geom_bodyid == body)[0])
            signs = np.array([(x, y, -1) for x in (1, -1) for y in (1, -1)])
            self.corners.append(model.geom_pos[geom] + model.geom_size[geom] * signs)
        self.load = np.zeros(2)

    def lowest(self, data: Any) -> float:
        return min(
            float((data.xpos[b] + c @ data.xmat[b].reshape(3, 3).T)[:, 2].min())
            for b, c in zip(self.bodies, self.corners, strict=True)
        )

    def push(self, model: Any, data: Any) -> None:
        import mujoco

        ground, speed = self.ground, np.zeros(6)
        for foot, body in enumerate(self.bodies):
            arm = self.corners[foot] @ data.xmat[body].reshape(3, 3).T
            depth = np.maximum(-(arm + data.xpos[body])[:, 2], 0.0)
            self.load[foot] = 0.0
            if not depth.any():
                continue
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, speed, 0)
            velocity = speed[3:] + np.cross(speed[:3], arm)
            normal = np.maximum(ground.stiffness * depth * (1 - ground.damping / 0.05 * velocity[:, 2]), 0.0)
            slip = velocity[:, :2] / np.sqrt((velocity[:, :2] ** 2).sum(axis=1) + ground.creep**2)[:, None]
            force = np.column_stack([-ground.friction * normal[:, None] * slip, normal])
            self.load[foot] = normal.sum()
            torque = np.cross(arm, force).sum(axis=0)
            mujoco.mj_applyFT(model, data, force.sum(axis=0), torque, data.xpos[body], body, data.qfrc_passive)


def _log(
    model: Any,
    time: np.ndarray[Any, Any],
    joints: Sequence[str],
    commands: np.ndarray[Any, Any],
    rows: np.ndarray[Any, Any],
    rng: Generator,
) -> Log:
    """Sensors with noise; the force on a foot is shared out evenly among its sensors."""
    n, k = len(time), len(joints)
    seen = np.round((rows[:, :k] + rng.normal(scale=4e-4, size=(n, k))) / TICK) * TICK
    channels = {f"command.{j}": commands[:, i] for i, j in enumerate(joints)}
    channels |= {f"position.{j}": seen[:, i] for i, j in enumerate(joints)}
    imu = [f"{kind}_{axis}" for kind in ("gyro", "acc") for axis in "xyz"] + ["angle_x", "angle_y"]
    noise = np.repeat([0.01, 0.05, 3e-3], [3, 3, 2])
    for i, name in enumerate(imu):
        channels[f"imu.{name}"] = rows[:, k + i] + rng.normal(scale=noise[i], size=n)
    names = [model.sensor(i).name for i in range(model.nsensor)]
    cells = [name.removeprefix("force_") for name in names if name.startswith("force_")]
    for foot, side in enumerate("LR"):
        own = [cell for cell in cells if cell.startswith(side)]
        channels |= {f"force.{cell}": rows[:, k + 8 + foot] / len(own) for cell in own}
    meta = LogMeta(robot="nao", mount="free", sample_period=PERIOD, source="simulated")
    return Log(time=time, channels=channels, meta=meta, episode=np.zeros(n, dtype=np.int64))


def examine(walker: Walker, log: Log, threads: int) -> pd.DataFrame:
    """One row for each parameter of which the truth is known."""
    found = fit(make_study(load_robot("nao"), [log], mode=Mode("segments"), threads=threads), [*INERTIAL, *CONTACT])
    truth = {f"mass:{name}": factor for name, factor in walker.masses.items()}
    truth |= {"kp:*": walker.kp, "kv:*": walker.kv, "foot_friction:*AnkleRoll": walker.ground.friction}
    score = found.before.holdout["position"]
    return pd.DataFrame(
        {
            "walk": walker.seed,
            "stiffness": round(walker.ground.stiffness),
            "parameter": e.name,
            "truth": truth[e.name],
            "value": e.value,
            "std": e.std,
            "inside": e.ci95[0] <= truth[e.name] <= e.ci95[1],
            "over_floor": score.rmse / score.floor,
        }
        for e in found.estimates
        if e.name in truth
    )


def summary(table: pd.DataFrame) -> str:
    """How often intervals hold, and how far estimates are off in standard errors, by kind of parameter."""
    kinds = {
        "legs": table.parameter.str.startswith("mass:") & ~table.parameter.str.contains("Shoulder"),
        "arms": table.parameter.str.contains("Shoulder"),
        "kp, kv": table.parameter.str.startswith(("kp", "kv")),
        "foot friction": table.parameter.str.startswith("foot_friction"),
    }
    lines = [f"{table.walk.nunique()} walks"]
    for name, own in kinds.items():
        rows = table[own]
        error = (rows.value - rows.truth) / rows["std"]
        lines.append(
            f"{name:<14} {int(rows.inside.sum()):3d} of {len(rows):3d} inside ci95"
            f"   rms error {np.sqrt((error**2).mean()):.2f} std   median std {rows['std'].median():.3f}"
        )
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ground", description=__doc__)
    parser.add_argument(
        "--walks", metavar="A-B", default="0-17", help="numbers of walkers; those that fall are skipped"
    )
    parser.add_argument("--out", type=Path, default=RESULTS, help="table to continue")
    parser.add_argument("--threads", type=int, default=0, help="worker threads, 0 for all cores")
    options = parser.parse_args(argv)
    first, _, last = options.walks.partition("-")
    table = [pd.read_csv(options.out)] if options.out.exists() else []
    done = {int(walk) for rows in table for walk in rows.walk}
    for seed in range(int(first), int(last or first) + 1):
        if seed in done:
            continue
        walker = draw(seed)
        log = record(walker)
        if log is None:
            print(f"walk {seed}: falls", file=sys.stderr, flush=True)
            continue
        rows = examine(walker, log, options.threads)
        table.append(rows)
        pd.concat(table).to_csv(options.out, index=False, float_format="%.5g")
        print(f"walk {seed}: {int(rows.inside.sum())} of {len(rows)} inside", file=sys.stderr, flush=True)
    if table:
        print(summary(pd.concat(table)), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
