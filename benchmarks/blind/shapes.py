"""Random forms of known families that the library has not exactly, of realistic size."""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.blind.sizes import SHARP, SMOOTH, TIMED, Recipe, across, either_sign, log_uniform
from reference_simulator import forms

if TYPE_CHECKING:
    import numpy as np
    from numpy.random import Generator
    from numpy.typing import NDArray

    from benchmarks.blind.sizes import Stage
    from reference_simulator.effects import Effect

    Array = NDArray[np.float64]
    Names = tuple[str, ...]

SLOW = ("multisine", "poses", "triangles", "gait")


def _asymmetric(rng: Generator, stage: Stage, where: Names) -> Effect:
    levels = sorted((log_uniform(rng, 0.15, 0.45), rng.uniform(0.0, 0.12)), reverse=bool(rng.integers(2)))
    return forms.AsymmetricFriction(where=where, forward=levels[0], backward=levels[1])


def _stribeck(rng: Generator, stage: Stage, where: Names) -> Effect:
    coulomb = rng.uniform(0.08, 0.25)
    return forms.StretchedStribeck(
        where=where,
        static=coulomb * rng.uniform(1.3, 2.2),
        coulomb=coulomb,
        velocity=rng.uniform(0.05, 0.4),
        exponent=rng.uniform(0.5, 1.2),
        viscous=rng.uniform(0.0, 0.1),
    )


def _presliding(rng: Generator, stage: Stage, where: Names) -> Effect:
    return forms.PreslidingFriction(
        where=where,
        coulomb=log_uniform(rng, 0.12, 0.4),
        yielding=log_uniform(rng, 0.005, 0.04),
        stiction=float(rng.choice([1.0, 1.5])),
    )


def _cyclic(rng: Generator, stage: Stage, where: Names) -> Effect:
    return forms.CyclicFriction(
        where=where,
        torque=log_uniform(rng, 0.12, 0.4),
        depth=rng.uniform(0.4, 0.9),
        periods=rng.uniform(3.0, 12.0),
        phase=rng.uniform(0.0, 6.28),
    )


def _jitter(rng: Generator, stage: Stage, where: Names) -> Effect:
    least = rng.uniform(0.0, 0.02)
    return forms.JitteringDelay(where=where, least=least, most=least + rng.uniform(0.02, 0.04))


def _ramp(rng: Generator, stage: Stage) -> dict[str, float]:
    return {
        "depth": rng.uniform(0.15, 0.4),
        "start": rng.uniform(0.1, 0.4) * stage.seconds,
        "duration": rng.uniform(0.1, 0.5) * stage.seconds,
    }


def _sag(rng: Generator, stage: Stage, where: Names) -> Effect:
    share = rng.uniform(0.15, 0.35) / float(stage.torque_rms.sum())
    return forms.StiffnessSag(per_torque=share, lag=rng.uniform(0.01, 0.1))


def _soft_limit(rng: Generator, stage: Stage, where: Names) -> Effect:
    return forms.SoftTorqueLimit(where=where, limit=rng.uniform(0.6, 1.1) * stage.least(stage.torque_peak, where))


def _eccentric(rng: Generator, stage: Stage, where: Names) -> Effect:
    return forms.EccentricEncoder(
        where=where, amplitude=rng.uniform(0.01, 0.04), periods=float(rng.integers(2, 9)), phase=rng.uniform(0.0, 6.28)
    )


def _drift(rng: Generator, stage: Stage, where: Names) -> Effect:
    return forms.EncoderDrift(
        where=where, drift=either_sign(rng, 0.02, 0.08), time_constant=rng.uniform(0.2, 0.8) * stage.seconds
    )


def _cubic(rng: Generator, stage: Stage, where: Names) -> Effect:
    j = stage.robot.indices(where)[0]
    return forms.CubicSpring(where=where, stiffness=log_uniform(rng, 0.5, 6.0), rest=float(stage.centre[j]))


def _one_sided(rng: Generator, stage: Stage, where: Names) -> Effect:
    j = stage.robot.indices(where)[0]
    side = float(rng.choice([-1.0, 1.0]))
    onset = stage.centre[j] + side * rng.uniform(-0.5, 0.7) * stage.spread[j]
    return forms.OneSidedSpring(where=where, stiffness=log_uniform(rng, 0.8, 6.0), onset=float(onset), side=side)


def _band(rng: Generator, stage: Stage, where: Names) -> Effect:
    """From near the body's end to a point beside and below the robot."""
    x, y, z = rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), rng.uniform(0.0, 0.3)
    return forms.ElasticBand(
        where=where,
        stiffness=log_uniform(rng, 4.0, 25.0),
        offset=across(rng, stage, where[0], rng.uniform(0.02, 0.06)),
        anchor=(float(x), float(y), float(z)),
        length=rng.uniform(0.1, 0.3),
    )


def _load(rng: Generator, stage: Stage, where: Names) -> Effect:
    offset = across(rng, stage, where[0], rng.uniform(0.04, 0.1))
    return forms.SolidLoad(where=where, mass=rng.uniform(0.1, 0.35), radius=rng.uniform(0.03, 0.08), offset=offset)


def _sine(rng: Generator, stage: Stage, where: Names) -> Effect:
    return forms.SineTorque(
        where=where, amplitude=rng.uniform(0.3, 1.0), frequency=log_uniform(rng, 1.0, 5.0), phase=rng.uniform(0.0, 6.28)
    )


def _ringing(rng: Generator, stage: Stage, where: Names) -> Effect:
    return forms.RingingTorque(
        where=where,
        amplitude=either_sign(rng, 0.6, 2.0),
        frequency=rng.uniform(1.5, 5.0),
        decay=rng.uniform(0.2, 0.8),
        start=rng.uniform(0.1, 0.3) * stage.seconds,
        every=rng.uniform(0.2, 0.4) * stage.seconds,
    )


SHAPES: dict[str, Recipe] = {
    "asymmetric_friction": Recipe(_asymmetric, SLOW),
    "smoothed_command": Recipe(
        lambda r, s, w: forms.SmoothedCommand(where=w, lag=r.uniform(0.006, 0.02)), TIMED, everywhere=True
    ),
    "stretched_stribeck": Recipe(_stribeck, SLOW),
    "stiffness_ramp": Recipe(
        lambda r, s, w: forms.StiffnessRamp(**_ramp(r, s)),
        ("multisine", "steps", "poses"),
        scope="robot",
        drive="servo",
    ),
    "smooth_backlash": Recipe(
        lambda r, s, w: forms.SmoothBacklash(
            where=w, play=r.uniform(0.02, 0.06), stiffness=log_uniform(r, 100.0, 500.0)
        ),
        SLOW,
    ),
    "sine_torque": Recipe(_sine, SMOOTH),
    "eccentric_encoder": Recipe(_eccentric, ("multisine", "poses", "triangles")),
    "presliding_friction": Recipe(_presliding, SLOW),
    "solid_load": Recipe(_load, SMOOTH, scope="body"),
    "jittering_delay": Recipe(_jitter, TIMED, everywhere=True),
    "cubic_spring": Recipe(_cubic, ("multisine", "poses", "steps")),
    "soft_torque_limit": Recipe(_soft_limit, SHARP),
    "power_ramp": Recipe(
        lambda r, s, w: forms.PowerRamp(**_ramp(r, s)), ("multisine", "steps", "poses"), scope="robot", drive="motor"
    ),
    "root_load_friction": Recipe(
        lambda r, s, w: forms.RootLoadFriction(where=w, coefficient=r.uniform(0.08, 0.3)), SMOOTH, everywhere=True
    ),
    "encoder_drift": Recipe(_drift, ("multisine", "poses", "steps"), effort=True),
    "ringing_torque": Recipe(_ringing, SMOOTH),
    "power_damping": Recipe(
        lambda r, s, w: forms.PowerDamping(where=w, coefficient=log_uniform(r, 0.06, 0.3)), SHARP, effort=True
    ),
    "greased_backlash": Recipe(
        lambda r, s, w: forms.GreasedBacklash(
            where=w, play=r.uniform(0.02, 0.06), stiffness=log_uniform(r, 100.0, 400.0), damping=r.uniform(0.1, 0.5)
        ),
        SLOW,
    ),
    "rare_commands": Recipe(
        lambda r, s, w: forms.RareCommands(where=w, period=r.uniform(0.023, 0.06), phase=r.uniform(0.0, 1.0)),
        TIMED,
        everywhere=True,
    ),
    "elastic_band": Recipe(_band, SMOOTH, scope="body"),
    "cyclic_friction": Recipe(_cyclic, SLOW),
    "stiffness_sag": Recipe(_sag, ("multisine", "steps", "chirp"), scope="robot", drive="servo"),
    "one_sided_spring": Recipe(_one_sided, ("multisine", "poses", "steps")),
    "encoder_filter": Recipe(
        lambda r, s, w: forms.EncoderFilter(where=w, lag=r.uniform(0.008, 0.03)), TIMED, everywhere=True, effort=True
    ),
}
