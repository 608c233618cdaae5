"""The command line: ``sysid-btr VERB``. Results go to stdout, progress and remarks to stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from sysid_btr import __version__
from sysid_btr.errors import InterruptedRun, LogError, SysidError, UsageError
from sysid_btr.session import Folder, Interrupted, ProgressLine, interruptible, open_folder, write_all

if TYPE_CHECKING:
    from sysid_btr._typing import FloatArray
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.estimators.journal import Journal
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.study import Study
    from sysid_btr.io.log import Log
    from sysid_btr.models.modifier import Parameter
    from sysid_btr.models.robot import Robot

    Job = Callable[[Study, ProgressLine], Fit | Closing]

EXIT_CODES = """
Exit codes: 0 done; 1 a defect of this program; 2 usage; 3 a log cannot be used; 4 the model cannot be used or
does not fit the log; 5 finished and written, but the fit did not converge or the log tells not one of its
parameters (some not identifiable beside others that are is a result: 0); 130 interrupted, journal kept.
"""
DECLARED = ("mass:*", "kp:*=shared", "kv:*=shared")
"""What `close` frees where nothing is said: a wrong mass or gain must not pass for an effect."""
NOTHING = "none"
DEMO_OUT = "demo_out"

app = typer.Typer(
    name="sysid-btr",
    help="Make a MuJoCo model move like the robot in a log: which parameters, how sure, what is missing."
    "\n\n" + EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and end the process with its exit code."""
    sys.exit(run(sys.argv[1:] if argv is None else argv))


def run(argv: Sequence[str]) -> int:
    """Run the command line; the exit code. No error reaches the user as a traceback."""
    try:
        with interruptible():
            app(list(argv), prog_name="sysid-btr")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1
    except Interrupted:
        _remark("interrupted")
        return InterruptedRun.exit_code
    except SysidError as error:
        _remark(f"error: {error}")
        return error.exit_code
    except Exception as error:
        if "--debug" in argv:
            raise
        _remark(
            f"internal error: {type(error).__name__}: {error}\n"
            "This is a defect of sysid-btr, not of your data. Run the command again with --debug and report "
            "what it prints, with the output of `sysid-btr --version`, to the project's issue tracker."
        )
        return 1
    return 0


def _remark(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


# --- options, the same for every verb ------------------------------------------------------------------


def _config(context: typer.Context, path: Path | None) -> Path | None:
    if path is not None:
        from sysid_btr.config import read_study_file

        flags = read_study_file(path)
        known = {p.name for p in context.command.params}
        context.default_map = {name: value for name, value in flags.items() if name in known}
    return path


def _version(wanted: bool) -> None:
    if wanted:
        from sysid_btr.result import versions

        sys.stdout.write(", ".join(f"{name} {version}" for name, version in versions().items()) + "\n")
        raise typer.Exit


Config = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        is_eager=True,
        callback=_config,
        help="Study file (TOML): any flag of any verb as `name = value`; flags given here win.",
    ),
]
Model = Annotated[
    str | None,
    typer.Option("--model", "-m", metavar="NAME|FILE", help="Built-in robot, or an MJCF or URDF file."),
]
Logs = Annotated[
    list[Path] | None, typer.Option("--log", "-l", metavar="FILE", help="Log (Parquet); repeat for several.")
]
Holdout = Annotated[
    list[str] | None,
    typer.Option(
        "--holdout",
        metavar="FILE|FRACTION",
        help="Log(s) that are not fitted, or the last fraction of each log. [default: 0.3]",
    ),
]
Free = Annotated[
    list[str] | None,
    typer.Option(
        "--fit",
        "-f",
        metavar="FIELD:GLOB[,GLOB..][=shared]",
        help="Parameters to free, e.g. mass:*Knee* or kp:*=shared; repeatable.",
    ),
]
Starts = Annotated[
    list[str] | None,
    typer.Option(
        "--start",
        metavar="NAME=VALUE",
        help="Where the search begins, by parameter name or glob, e.g. mass:slider=0.7; repeatable.",
    ),
]
Bounds = Annotated[
    list[str] | None,
    typer.Option(
        "--bounds", metavar="NAME=LOW:HIGH", help="Bounds of a parameter or a whole field, e.g. kp=0.5:2."
    ),
]
Channels = Annotated[
    list[str] | None,
    typer.Option(
        "--channels",
        metavar="NAME[,NAME..]",
        help="Channels to fit: position, velocity, effort. [default: position and effort where logged]",
    ),
]
EstimatorName = Annotated[
    str,
    typer.Option("--estimator", metavar="NAME", help="lsq, ga, cmaes, nlopt:ALGORITHM, or one installed."),
]
MaxEvaluations = Annotated[
    int | None, typer.Option("--max-evaluations", min=1, help="Stop the search after this many replays.")
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Of all random numbers.")]
Threads = Annotated[int, typer.Option("--threads", min=0, help="Worker threads; 0 for all cores.")]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        metavar="DIR",
        help="Folder for result.json, overlay.png, report.html and the journal. "
        "Without it nothing is written: results go to stdout only.",
    ),
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Go on where an interrupted run with the same --out stopped.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace earlier results in --out.")]
Json = Annotated[bool, typer.Option("--json", help="Print result.json instead of tables.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")]


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print versions and exit.")
    ] = False,
) -> None:
    pass


# --- verbs ----------------------------------------------------------------------------------------------


@app.command()
def validate(
    files: Annotated[list[Path] | None, typer.Argument(metavar="[FILE]...", help="Logs to check.")] = None,
    log: Logs = None,
    model: Model = None,
    as_json: Json = False,
    config: Config = None,
    debug: Debug = False,
) -> None:
    """Say everything that is wrong with a log, where, and what to do about it (exit 3 on errors)."""
    from sysid_btr.io.problem import errors_of
    from sysid_btr.io.validation import validate_file
    from sysid_btr.models.robot import joint_names, joint_ranges, load_robot

    paths = [*(files or []), *(log or [])]
    if not paths:
        raise UsageError("which log? Give one or more files: sysid-btr validate walk.parquet")
    robot = None if model is None else load_robot(model)
    joints = None if robot is None else joint_names(robot)
    ranges = None if robot is None else joint_ranges(robot)
    found = {path: validate_file(path, joints=joints, ranges=ranges) for path in paths}
    if as_json:
        _print_json({str(path): problems for path, problems in found.items()})
    else:
        from sysid_btr.report.text import console, problems_table

        out = console(sys.stdout)
        for path, problems in found.items():
            errors = len(errors_of(problems))
            warnings = len(problems) - errors
            out.print(f"{path}: {_count(errors, 'error')}, {_count(warnings, 'warning')}")
            if problems:
                out.print(problems_table(problems))
    if any(errors_of(problems) for problems in found.values()):
        raise typer.Exit(LogError.exit_code)


@app.command()
def replay(
    model: Model = None,
    log: Logs = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="PARAMETERS=VALUE", help="Change the model first, e.g. 'kp:*=0.9'; repeatable."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder for the predicted logs.")
    ] = None,
    overwrite: Overwrite = False,
    threads: Threads = 0,
    as_json: Json = False,
    config: Config = None,
    debug: Debug = False,
) -> None:
    """Give the log's commands to the model and compare its sensors with the log's; nothing is fitted."""
    from sysid_btr.identify.scores import score_problem
    from sysid_btr.identify.study import make_study
    from sysid_btr.objectives.targets import COMPARED
    from sysid_btr.replay.log import replay_log, set_parameters
    from sysid_btr.result import replay_result

    began = time.perf_counter()
    robot = _robot(model, None)
    logs = _read_logs(log)
    parameters = dict(_assignments("--set", set_))
    modifiers, values = set_parameters(robot, parameters)
    targets = _replay_targets(out, logs, overwrite)
    study = make_study(robot, logs, holdout=logs, channels=COMPARED, threads=threads)
    scores = score_problem(study.train_problem(modifiers), values)
    for path, one in zip(targets, logs, strict=False):
        from sysid_btr.io.parquet import write_log

        predicted = replay_log(robot, one, parameters, numerics=study.numerics, threads=threads)
        write_log(predicted, path, overwrite=overwrite)
    result = replay_result(study, scores, parameters, time.perf_counter() - began)
    if as_json:
        _print_json(result)
        return
    from sysid_btr.report.text import console, joints_table, show

    screen = console(sys.stdout)
    show(result, screen)
    position = scores.get("position")
    if position is not None:
        unit = result["units"]["position"].partition(",")[0]
        screen.print(joints_table(position.joints, unit))
    for path in targets:
        _remark(f"predicted log: {path}")


@app.command()
def fit(
    model: Model = None,
    log: Logs = None,
    free: Free = None,
    holdout: Holdout = None,
    start: Starts = None,
    bounds: Bounds = None,
    channels: Channels = None,
    estimator: EstimatorName = "lsq",
    max_evaluations: MaxEvaluations = None,
    seed: Seed = 0,
    threads: Threads = 0,
    out: Out = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    as_json: Json = False,
    config: Config = None,
    debug: Debug = False,
) -> None:
    """Fit parameters of the model to the log: values, intervals, error before and after on held-out data.

    Exit 5 if the search did not converge or the log tells none of the parameters; the results are written all
    the same.
    """
    from sysid_btr.estimators import get_estimator
    from sysid_btr.estimators.base import Budget
    from sysid_btr.identify.fit import fit as fit_study

    robot = _robot(model, bounds)
    if not free:
        raise UsageError(_what_can_be_freed(robot))
    chosen = get_estimator(estimator)
    request = Request(
        "fit",
        robot,
        _read_logs(log),
        holdout,
        free,
        channels,
        threads,
        seed,
        {"estimator": estimator, "start": start or [], "bounds": bounds or []},
    )
    keeper = Keeper.open(out, resume, overwrite, request)

    def job(study: Study, progress: ProgressLine) -> Fit:
        modifiers = study.declare(free)
        parameters = [p for m in modifiers for p in m.parameters]
        return fit_study(
            study,
            modifiers,
            estimator=chosen,
            rng=_generator(seed),
            budget=Budget(evaluations=max_evaluations),
            journal=keeper.journal,
            progress=progress,
            start=_start(parameters, start),
        )

    _finish(request, keeper, job, as_json)


@app.command()
def close(
    model: Model = None,
    log: Logs = None,
    free: Free = None,
    effects: Annotated[
        list[str] | None,
        typer.Option(
            "--effects", metavar="all|NAME[,NAME..]", help="Effects that may be named. [default: all]"
        ),
    ] = None,
    holdout: Holdout = None,
    bounds: Bounds = None,
    channels: Channels = None,
    seed: Seed = 0,
    threads: Threads = 0,
    out: Out = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    as_json: Json = False,
    config: Config = None,
    debug: Debug = False,
) -> None:
    """Find what the model is missing: fit the parameters, trace what is left to an effect, add it, refit.

    Shows the held-out error before and after.

    Without --fit all masses and the common servo gains are freed, so that a wrong mass does not pass for an
    effect; --fit none trusts the model as it is.
    """
    from sysid_btr.effects.library import select_effects

    robot = _robot(model, bounds)
    names = _split(effects) or ["all"]
    select_effects(names)
    declared = _declared(robot, free)
    request = Request(
        "close",
        robot,
        _read_logs(log),
        holdout,
        declared,
        channels,
        threads,
        seed,
        {"effects": names, "bounds": bounds or []},
    )
    keeper = Keeper.open(out, resume, overwrite, request)
    _finish(request, keeper, _closing_job(declared, names, seed, keeper), as_json)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The --out folder of a finished run.")],
    debug: Debug = False,
) -> None:
    """Write report.html again from result.json and overlay.png of a finished run."""
    from sysid_btr.report.html import render
    from sysid_btr.result import read_result
    from sysid_btr.session import OVERLAY, REPORT

    result = read_result(folder)
    overlay = folder / OVERLAY
    page = render(result, overlay.read_bytes() if overlay.is_file() else None)
    sys.stdout.write(f"{Folder(folder).write(REPORT, page)}\n")


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder of the reports.")] = Path(
        DEMO_OUT
    ),
    threads: Threads = 0,
    debug: Debug = False,
) -> None:
    """One minute: close the loop on a sample log whose robot has something that its model lacks.

    And on a measured log, where the recordings are at hand (SYSID_BTR_DATA).
    """
    from sysid_btr.demo import cases

    for case in cases():
        _remark(f"\n== {case.title}\n$ {case.command(out)}")
        robot = _robot(case.model, None)
        request = Request("close", robot, _read_logs([case.log]), None, list(case.free), None, threads, 0, {})
        keeper = Keeper.open(out / case.name, False, True, request)
        code = _run(request, keeper, _closing_job(list(case.free), ["all"], 0, keeper), False)
        if code:
            raise typer.Exit(code)


# --- what the verbs share -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Request:
    """What a fit or a closing was asked for."""

    kind: str
    robot: Robot
    logs: list[Log]
    holdout: list[str] | None
    free: list[str]
    channels: list[str] | None
    threads: int
    seed: int
    settings: dict[str, Any]

    def study(self) -> Study:
        """Logs and model laid out; remarks on the logs go to stderr."""
        from sysid_btr.identify.study import make_study
        from sysid_btr.objectives.targets import FITTED

        chosen = _channels(self.channels) or FITTED
        for log in self.logs:
            _warn(self.robot, log)
        return make_study(
            self.robot,
            self.logs,
            holdout=_holdout(self.holdout),
            channels=chosen,
            threads=self.threads,
        )

    def fingerprint(self) -> str:
        """Digest of all that decides which candidates are evaluated."""
        import hashlib
        import json

        from sysid_btr.io.parquet import sha256

        held = [sha256(p) if Path(p).is_file() else p for p in self.holdout or []]
        content = {
            "version": __version__,
            "kind": self.kind,
            "model": self.robot.digest,
            "logs": [sha256(log.path) for log in self.logs if log.path is not None],
            "holdout": held,
            "fit": self.free,
            "channels": _channels(self.channels),
            "seed": self.seed,
            **self.settings,
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class Keeper:
    """Where a run keeps what it finds: a folder and its journal, or memory alone."""

    folder: Folder | None
    journal: Journal

    @classmethod
    def open(cls, out: Path | None, resume: bool, overwrite: bool, request: Request) -> Keeper:
        from sysid_btr.estimators.journal import Journal

        if out is None:
            if resume:
                raise UsageError("--resume goes on with the journal of an earlier run: give its --out folder")
            return cls(None, Journal())
        folder = open_folder(out, resume=resume, overwrite=overwrite)
        return cls(folder, Journal(folder.journal, fingerprint=request.fingerprint()))


def _closing_job(declared: list[str], effects: list[str], seed: int, keeper: Keeper) -> Job:
    def job(study: Study, progress: ProgressLine) -> Closing:
        from sysid_btr.diagnosis.close import close as close_loop

        return close_loop(
            study,
            declared,
            effects=tuple(effects),
            rng=_generator(seed),
            journal=keeper.journal,
            progress=progress,
        )

    return job


def _finish(request: Request, keeper: Keeper, job: Job, as_json: bool) -> None:
    code = _run(request, keeper, job, as_json)
    if code:
        raise typer.Exit(code)


def _run(request: Request, keeper: Keeper, job: Job, as_json: bool) -> int:
    """Do the work, write and print what it found; the exit code."""
    from sysid_btr.result import exit_code, make_result

    began = time.perf_counter()
    with ProgressLine(request.kind) as progress:
        try:
            outcome = job(request.study(), progress)
        except Interrupted:
            raise InterruptedRun(_interrupted(keeper, progress)) from None
    result = make_result(outcome, seed=request.seed, wall_s=time.perf_counter() - began)
    if keeper.folder is not None:
        page = write_all(keeper.folder, outcome, result)
        _remark(f"report: {page}")
    if as_json:
        _print_json(result)
    else:
        from sysid_btr.report.text import console, show

        show(result, console(sys.stdout))
    return exit_code(result)


def _interrupted(keeper: Keeper, progress: ProgressLine) -> str:
    if keeper.folder is None:
        return "interrupted; nothing is kept without --out"
    return (
        f"interrupted at loss {progress.best:.4g}; {len(keeper.journal)} evaluations are kept in "
        f"{keeper.folder.journal}: the same command with --resume goes on from there"
    )


def _robot(name: str | None, bounds: list[str] | None) -> Robot:
    from dataclasses import replace

    from sysid_btr.models.builtin import BUILTIN
    from sysid_btr.models.robot import load_robot

    if name is None:
        built_in = f" ({', '.join(sorted(BUILTIN))})" if BUILTIN else ""
        raise UsageError(f"which robot? Give --model: a built-in name{built_in} or an MJCF or URDF file")
    robot = load_robot(name)
    table = dict(_bounds(bounds))
    return replace(robot, bounds={**robot.bounds, **table}) if table else robot


def _read_logs(paths: Iterable[Path] | None) -> list[Log]:
    """All logs, or one error that lists what is wrong with each of them."""
    from sysid_btr.io.parquet import read_log

    logs, problems = [], []
    for path in paths or ():
        try:
            logs.append(read_log(path))
        except LogError as error:
            problems.append(str(error))
    if problems:
        raise LogError("\n".join(problems))
    if not logs:
        raise UsageError("which log? Give --log FILE, once for each log")
    return logs


def _warn(robot: Robot, log: Log) -> None:
    """Remarks of the validation on a log that can be used all the same."""
    from sysid_btr.io.validation import validate_log
    from sysid_btr.models.robot import joint_names, joint_ranges

    for problem in validate_log(log, joints=joint_names(robot), ranges=joint_ranges(robot)):
        _remark(f"warning: {log.path}: {problem.where}: {problem.message} [{problem.code}]")


def _holdout(given: list[str] | None) -> float | list[Log]:
    if not given:
        return 0.3
    numbers = [_number(text) for text in given]
    if len(given) == 1 and numbers[0] is not None:
        return numbers[0]
    if any(n is not None for n in numbers):
        raise UsageError(f"--holdout takes one fraction or log files, not both: {', '.join(given)}")
    return _read_logs([Path(text) for text in given])


def _channels(given: list[str] | None) -> tuple[str, ...]:
    from sysid_btr.objectives.targets import COMPARED

    names = _split(given)
    unknown = [name for name in names if name not in COMPARED]
    if unknown:
        raise UsageError(f"--channels: unknown {', '.join(unknown)}; a replay predicts {', '.join(COMPARED)}")
    return tuple(names)


def _declared(robot: Robot, free: list[str] | None) -> list[str]:
    """What `close` frees."""
    from sysid_btr.models.robot import servo_joints

    if free == [NOTHING]:
        return []
    if free:
        return free
    declared = [p for p in DECLARED if p.startswith("mass") or servo_joints(robot)]
    _remark(f"freeing {', '.join(declared)} (--fit says otherwise, --fit none nothing)")
    return declared


def _what_can_be_freed(robot: Robot) -> str:
    from sysid_btr.models.fields import FIELDS
    from sysid_btr.models.robot import body_names, joint_names, servo_joints

    fields: dict[str, list[str]] = {}
    for name, cls in FIELDS.items():
        fields.setdefault(cls.scope, []).append(name)
    lines = [
        f"what shall be fitted? Give --fit FIELD:GLOB[,GLOB..][=shared], once or more. {robot.name} has",
    ]
    for scope, names in (
        ("body", body_names(robot)),
        ("joint", joint_names(robot)),
        ("servo", servo_joints(robot)),
    ):
        noun = {"body": "bodies", "joint": "joints", "servo": "joints with a servo"}[scope]
        lines.append(f"  {', '.join(fields.get(scope, []))}\n    of {noun}: {', '.join(names) or 'none'}")
    lines.append("for example: --fit 'mass:*' --fit 'kp:*=shared'")
    return "\n".join(lines)


def _start(parameters: Sequence[Parameter], given: list[str] | None) -> FloatArray:
    """Where the search begins: the nominal values, but for those given by name or glob.

    Raises
    ------
    UsageError
        For names that no free parameter has, and values outside the bounds; all of them at once.
    """
    from fnmatch import fnmatchcase

    import numpy as np

    values = np.array([p.nominal for p in parameters])
    problems = []
    for name, value in _assignments("--start", given):
        chosen = [i for i, p in enumerate(parameters) if p.name == name] or [
            i for i, p in enumerate(parameters) if fnmatchcase(p.name, name)
        ]
        if not chosen:
            problems.append(
                f"{name} is not a free parameter; there are {', '.join(p.name for p in parameters)}"
            )
        for i in chosen:
            p = parameters[i]
            if not p.lower <= value <= p.upper:
                problems.append(f"{p.name}={value:g} is outside its bounds {p.lower:g} to {p.upper:g}")
            values[i] = value
    if problems:
        raise UsageError("--start: " + "\n  ".join(problems))
    return values


def _assignments(flag: str, given: list[str] | None) -> list[tuple[str, float]]:
    pairs, problems = [], []
    for text in given or ():
        name, equals, right = text.rpartition("=")
        value = _number(right)
        if not equals or not name or value is None:
            problems.append(f"{flag} {text}: expected NAME=NUMBER")
        else:
            pairs.append((name, value))
    if problems:
        raise UsageError("\n".join(problems))
    return pairs


def _bounds(given: list[str] | None) -> list[tuple[str, tuple[float, float]]]:
    pairs, problems = [], []
    for text in given or ():
        name, _, right = text.rpartition("=")
        low, _, high = right.partition(":")
        lower, upper = _number(low), _number(high)
        if not name or lower is None or upper is None or not lower < upper:
            problems.append(f"--bounds {text}: expected NAME=LOW:HIGH with LOW < HIGH")
        else:
            pairs.append((name, (lower, upper)))
    if problems:
        raise UsageError("\n".join(problems))
    return pairs


def _number(text: str) -> float | None:
    import math

    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _split(given: list[str] | None) -> list[str]:
    return [name for text in given or () for name in text.split(",") if name]


def _generator(seed: int) -> Any:
    import numpy as np

    return np.random.default_rng(seed)


def _replay_targets(out: Path | None, logs: Sequence[Log], overwrite: bool) -> list[Path]:
    """Where the predicted logs go; refused before any work if something is in the way."""
    if out is None:
        return []
    targets = [out / f"{log.path.stem if log.path else 'log'}.replayed.parquet" for log in logs]
    if len(set(targets)) < len(targets):
        raise UsageError("two logs have the same file name, and so would their replays: run them one by one")
    there = [str(path) for path in targets if path.exists()]
    if there and not overwrite:
        raise UsageError(f"{', '.join(there)} exists; --overwrite replaces it, or choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {out} cannot be created: {error.strerror}; choose another folder") from error
    return targets


def _print_json(content: Any) -> None:
    from sysid_btr.result import to_json

    sys.stdout.write(to_json(content))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


if __name__ == "__main__":
    main()
