"""The command line: ``sysid-btr VERB``. Results go to stdout, progress and remarks to stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from sysid_btr.errors import InterruptedRun, LogError, SysidError, UsageError
from sysid_btr.request import (
    Keeper,
    Request,
    assignments,
    declared,
    find_robot,
    read_logs,
    remark,
    replay_targets,
    split_names,
    start_values,
    what_can_be_freed,
)
from sysid_btr.session import Folder, Interrupted, ProgressLine, interruptible, write_all

if TYPE_CHECKING:
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.study import Study

    Job = Callable[[Study, ProgressLine], Fit | Closing]

EXIT_CODES = """
Exit codes: 0 done; 1 a defect of this program; 2 usage; 3 a log cannot be used; 4 the model cannot be used or
does not fit the log; 5 finished and written, but the fit did not converge or the log tells not one of its
parameters (some not identifiable beside others that are is a result: 0); 130 interrupted, journal kept.
"""
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
        remark("interrupted")
        return InterruptedRun.exit_code
    except InterruptedRun as stop:
        remark(str(stop))
        return stop.exit_code
    except SysidError as error:
        remark(f"error: {error}")
        return error.exit_code
    except Exception as error:
        if "--debug" in argv:
            raise
        remark(
            f"internal error: {type(error).__name__}: {error}\n"
            "This is a defect of sysid-btr, not of your data. Run the command again with --debug and report "
            "what it prints, with the output of `sysid-btr --version`, to the project's issue tracker."
        )
        return 1
    return 0


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
DistanceName = Annotated[
    str,
    typer.Option(
        "--distance",
        metavar="NAME",
        help="What is minimised: likelihood (squares over noise); mse or phi2[:BINS], with ga, cmaes or nlopt.",
    ),
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
    robot = find_robot(model, None)
    logs = read_logs(log)
    parameters = dict(assignments("--set", set_))
    modifiers, values = set_parameters(robot, parameters)
    targets = replay_targets(out, logs, overwrite)
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
        remark(f"predicted log: {path}")


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
    distance: DistanceName = "likelihood",
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
    from sysid_btr.objectives.distance import get_distance

    robot = find_robot(model, bounds)
    if not free:
        raise UsageError(what_can_be_freed(robot))
    chosen = get_estimator(estimator)
    wanted = get_distance(distance)
    request = Request(
        "fit",
        robot,
        read_logs(log),
        holdout,
        free,
        channels,
        threads,
        seed,
        {"estimator": estimator, "distance": distance, "start": start or [], "bounds": bounds or []},
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
            start=start_values(parameters, start),
            distance=wanted,
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
    effect.
    """
    from sysid_btr.effects.library import select_effects

    robot = find_robot(model, bounds)
    names = split_names(effects) or ["all"]
    select_effects(names)
    parameters = declared(robot, free)
    request = Request(
        "close",
        robot,
        read_logs(log),
        holdout,
        parameters,
        channels,
        threads,
        seed,
        {"effects": names, "bounds": bounds or []},
    )
    keeper = Keeper.open(out, resume, overwrite, request)
    _finish(request, keeper, _closing_job(parameters, names, seed, keeper), as_json)


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
        remark(f"\n== {case.title}\n$ {case.command(out)}")
        robot = find_robot(case.model, None)
        request = Request("close", robot, read_logs([case.log]), None, list(case.free), None, threads, 0, {})
        keeper = Keeper.open(out / case.name, False, True, request)
        code = _run(request, keeper, _closing_job(list(case.free), ["all"], 0, keeper), False)
        if code:
            raise typer.Exit(code)


# --- what the verbs share --------------------------------------------------------------------------------


def _closing_job(parameters: list[str], effects: list[str], seed: int, keeper: Keeper) -> Job:
    def job(study: Study, progress: ProgressLine) -> Closing:
        from sysid_btr.diagnosis.close import close as close_loop

        return close_loop(
            study,
            parameters,
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
        remark(f"report: {page}")
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
        f"interrupted at loss {progress.best:.4g}; {keeper.journal.evaluations} replays are kept in "
        f"{keeper.folder.journal}: the same command with --resume goes on from there"
    )


def _generator(seed: int) -> Any:
    import numpy as np

    return np.random.default_rng(seed)


def _print_json(content: Any) -> None:
    from sysid_btr.result import to_json

    sys.stdout.write(to_json(content))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


if __name__ == "__main__":
    main()
