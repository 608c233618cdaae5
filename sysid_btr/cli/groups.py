"""Options that several verbs share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sysid_btr.cli.kinds import Holdout, Names, Numbers, Ranges
from sysid_btr.cli.options import Options, RunOptions, option

HOLDOUT = 0.3


@dataclass(frozen=True, kw_only=True)
class ModelOptions(Options):
    """The model."""

    model: str | None = option(
        None, "Built-in robot, or an MJCF or URDF file.", short="-m", metavar="NAME|FILE", beside=True, decides=True
    )
    servo: Names = option(
        (),
        "Put position servos on the joints that have none, in place of their motors.",
        metavar="kp=GAIN[,kv=GAIN]",
        decides=True,
    )
    at: Names = option(
        (),
        "Positions of joints that are not logged, rad or m.",
        otherwise="the log's metadata, the model's first keyframe, or zero",
        metavar="JOINT=VALUE|keyframe:NAME[,..]",
        decides=True,
    )


@dataclass(frozen=True, kw_only=True)
class LogOptions(Options):
    """Recordings."""

    log: tuple[Path, ...] = option((), "Recorded log (Parquet).", short="-l", metavar="FILE", beside=True, decides=True)


@dataclass(frozen=True, kw_only=True)
class ReadingOptions(LogOptions):
    """Recordings, and what is known of them beyond what they hold."""

    noise: Numbers = option(
        {},
        "Standard deviation of a channel's or column's noise (SI), e.g. position=1e-4.",
        otherwise="as the logs state it, or read from them",
        metavar="NAME=SIGMA",
        decides=True,
    )
    shift: Numbers = option(
        {},
        "Seconds to add to the times of a channel or column, e.g. command=1.41, where streams were not started "
        "together.",
        metavar="NAME=SECONDS",
        decides=True,
    )


@dataclass(frozen=True, kw_only=True)
class ParameterOptions(Options):
    """Which parameters of the model are free, and where."""

    fit: tuple[str, ...] = option(
        (),
        "Parameters to fit, e.g. mass:*Knee* or kp:*=shared.",
        short="-f",
        metavar="FIELD:GLOB[,GLOB..][=shared]",
        decides=True,
    )
    bounds: Ranges = option(
        {},
        "Bounds of a parameter, of all that a glob names or of a whole field, e.g. kp=0.5:2.",
        metavar="NAME=LOW:HIGH",
        decides=True,
    )


@dataclass(frozen=True, kw_only=True)
class ParamsOptions(Options):
    """An earlier run."""

    params: Path | None = option(
        None,
        "params.json of an earlier run, or its folder: start from its values (replay: use them, effects included).",
        metavar="FILE",
        beside=True,
        decides=True,
    )


@dataclass(frozen=True, kw_only=True)
class ModeOptions(Options):
    """How logs are compared with the model."""

    mode: str = option(
        "auto",
        "How logs are compared: forward drives the model by their commands, segments does so from one measured state "
        "after the other, inverse compares the torques that the motion requires, innovations (of a floating base) each "
        "sample with its prediction from those before it.",
        otherwise="auto: inverse where no command is logged and nothing swings by its weight, segments where "
        "the replay diverges from the log, innovations for a floating base",
        metavar="auto|forward|segments|inverse|innovations",
        decides=True,
    )
    segments: str = option(
        "auto",
        "Length of the segments of a robot whose base is fixed; whole replays the log from its first sample.",
        otherwise="auto: as long as the plain model can be followed",
        metavar="whole|auto|SECONDS",
        decides=True,
    )


@dataclass(frozen=True, kw_only=True)
class NumericsOptions(Options):
    """In what the identified model is to be used."""

    numerics: str | None = option(
        None,
        "Identify the model for this integrator and step, in which you will use it: implicitfast:0.002. Its parameters "
        "then make up for the integrator's error, and model.xml moves as reported in your own simulation.",
        otherwise="as exact as the log needs, RK4",
        short="--for",
        metavar="INTEGRATOR:STEP",
        decides=True,
    )


@dataclass(frozen=True, kw_only=True)
class StudyOptions(ModelOptions, ReadingOptions, ParameterOptions, ParamsOptions, ModeOptions, NumericsOptions):
    """What is fitted to what: shared by `fit`, `posterior` and `close`."""

    holdout: Holdout = option(
        HOLDOUT,
        "Held-out data, which are predicted and not fitted: logs, or the last fraction of each log.",
        metavar="FILE|FRACTION",
        beside=True,
        decides=True,
    )
    channels: Names = option(
        (),
        "Channels to fit: position, velocity, effort.",
        otherwise="position and effort where logged",
        metavar="NAME[,NAME..]",
        decides=True,
    )


@dataclass(frozen=True, kw_only=True)
class SearchOptions(Options):
    """How the best values are searched for."""

    start: Numbers = option(
        {}, "Initial value of a parameter, by name or glob, e.g. mass:slider=0.7.", metavar="NAME=VALUE", decides=True
    )
    estimator: str = option(
        "lsq",
        "How the values are searched for: lsq, ga, cmaes, nlopt:ALGORITHM, emcee, or an installed estimator; joined by "
        "+, each starts from the best of the one before (cmaes+lsq).",
        metavar="NAME[+NAME..]",
        decides=True,
    )
    distance: str = option(
        "likelihood",
        "What is minimised: likelihood (squares over noise); or mse, phi1, phi2[:BINS], wasserstein, with ga, cmaes or "
        "nlopt.",
        metavar="NAME",
        decides=True,
    )


@dataclass(frozen=True, kw_only=True)
class ThreadOptions(RunOptions):
    """What this process uses."""

    threads: int = option(0, "Worker threads; 0 for all cores.", metavar="N", least=0, decides=False)


@dataclass(frozen=True, kw_only=True)
class SimulatorOptions(RunOptions):
    """What moves the model."""

    simulator: str | None = option(
        None,
        "Simulator that moves the model: mujoco, or an installed one.",
        otherwise="mujoco; replay: that of --params",
        metavar="NAME",
        decides=True,
    )


@dataclass(frozen=True, kw_only=True)
class SeedOptions(RunOptions):
    """What a search uses."""

    seed: int = option(0, "Random seed.", metavar="N", least=0, decides=True)


@dataclass(frozen=True, kw_only=True)
class ExecutorOptions(RunOptions):
    """What a search uses that can run on many machines."""

    executor: str | None = option(
        None,
        "Simulate on the workers of a dask cluster, or on N one-thread worker processes; the results are the same.",
        otherwise="threads of this process",
        metavar="tcp://HOST:PORT|local[:N]",
        decides=False,
    )


@dataclass(frozen=True, kw_only=True)
class JsonOptions(RunOptions):
    """What is printed."""

    json: bool = option(False, "Print the result as JSON instead of tables.", decides=False)


@dataclass(frozen=True, kw_only=True)
class OutOptions(RunOptions):
    """What is kept of a run."""

    out: Path | None = option(
        None,
        "Folder for the results: result.json, reports, pictures, the journal, and what the verb makes. Without it "
        "nothing is written: results are only printed.",
        short="-o",
        metavar="DIR",
        decides=False,
    )
    resume: bool = option(False, "Continue an interrupted run with the same --out.", decides=False)
    overwrite: bool = option(False, "Replace earlier results in --out.", decides=False)


@dataclass(frozen=True, kw_only=True)
class RenderOptions(RunOptions):
    """What is kept of a run that changes a model."""

    render: bool = option(
        False, "Also draw log, model before and model after, side by side: render.png and render.gif.", decides=False
    )


@dataclass(frozen=True, kw_only=True)
class FittingOptions(
    StudyOptions, SimulatorOptions, SeedOptions, ThreadOptions, ExecutorOptions, OutOptions, RenderOptions, JsonOptions
):
    """What `fit`, `posterior` and `close` have in common."""


@dataclass(frozen=True, kw_only=True)
class NuisanceOptions(Options):
    """What is not fitted, and may be off."""

    nuisance: Numbers = option(
        {},
        "How well parameters are known that are not fitted, as a standard deviation, e.g. mass=0.1 (10 %).",
        otherwise="intervals take them as exact",
        metavar="NAME=STD",
        decides=True,
    )


@dataclass(frozen=True, kw_only=True)
class SearchingOptions(FittingOptions, SearchOptions):
    """What `fit` and `posterior` have in common."""
