"""The command line: ``sysid-btr VERB``. Results go to stdout, progress and remarks to stderr."""

from __future__ import annotations

import errno
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from sysid_btr.errors import InterruptedRun, LogError, LostCluster, SysidError, UsageError
from sysid_btr.progress import Interrupted, ProgressLine, interruptible
from sysid_btr.request import (
    Keeper,
    Request,
    assignments,
    declared,
    find_robot,
    known_starts,
    pairs,
    params_digest,
    read_logs,
    remark,
    replay_targets,
    split_names,
    start_values,
    what_can_be_freed,
    with_params,
)
from sysid_btr.run_folder import Folder
from sysid_btr.saving import as_model, write_all

if TYPE_CHECKING:
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.estimators.journal import Journal
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.study import Study
    from sysid_btr.io.log import Log
    from sysid_btr.models.robot import Robot
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.simulation.numerics import Numerics
    from sysid_btr.terms.model import Model as TermModel
    from sysid_btr.terms.model import Terms

    Job = Callable[[Study, ProgressLine], Fit | Closing | Posterior]

EXIT_CODES = """
Exit codes: 0 done; 1 a defect of this program; 2 usage; 3 a log cannot be used; 4 the model cannot be used or
does not fit the log; 5 finished and written, but the fit did not converge or the log tells not one of its
parameters (some not identifiable beside others that are is a result: 0); 130 interrupted, journal kept.
"""
DEMO_OUT = "demo_out"
OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM)
"""What the system says where something cannot be written."""

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
        if isinstance(error, OSError) and error.errno in OF_THE_DISK:
            where = f" {error.filename}" if error.filename else ""
            remark(f"error: cannot write{where}: {error.strerror}; make room, or choose a folder you may write to")
            return UsageError.exit_code
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
Params = Annotated[
    Path | None,
    typer.Option(
        "--params",
        metavar="FILE",
        help="params.json of an earlier run, or its folder: begin from its values (replay: with them, effects too).",
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
    typer.Option(
        "--estimator",
        metavar="NAME[+NAME..]",
        help="lsq, ga, cmaes, nlopt:ALGORITHM, emcee, or one installed; joined by +, each goes on from the best of "
        "the one before (cmaes+lsq).",
    ),
]
DistanceName = Annotated[
    str,
    typer.Option(
        "--distance",
        metavar="NAME",
        help="What is minimised: likelihood (squares over noise); or mse, phi1, phi2[:BINS], wasserstein, with ga, "
        "cmaes or nlopt.",
    ),
]
MaxEvaluations = Annotated[
    int | None, typer.Option("--max-evaluations", min=1, help="Stop the search after this many replays.")
]
Profiles = Annotated[
    list[str] | None,
    typer.Option(
        "--profile",
        metavar="NAME",
        help="Also follow the likelihood along this parameter (name or glob), the others fitted anew at each "
        "point: profile_NAME.png; repeatable.",
    ),
]
Priors = Annotated[
    list[str] | None,
    typer.Option(
        "--priors",
        metavar="NAME=PRIOR",
        help="Prior of a parameter, a glob or a whole field: uniform, normal(MEAN, STD), lognormal(MEDIAN, SPREAD). "
        "[default: the model's table, else uniform within the bounds]",
    ),
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Of all random numbers.")]
Threads = Annotated[int, typer.Option("--threads", min=0, help="Worker threads; 0 for all cores.")]
ExecutorPlace = Annotated[
    str | None,
    typer.Option(
        "--executor",
        metavar="tcp://HOST:PORT|local[:N]",
        help="Simulate on the workers of a dask cluster, or on N one-thread worker processes of its own; the results "
        "are the same. [default: threads of this process]",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        metavar="DIR",
        help="Folder for result.json, model.xml, params.json, overlay.png, report.html and the journal. "
        "Without it nothing is written: results go to stdout only.",
    ),
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Go on where an interrupted run with the same --out stopped.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace earlier results in --out.")]
Render = Annotated[
    bool,
    typer.Option(
        "--render", help="Also draw log, model before and model after, side by side: render.png and render.gif."
    ),
]
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
    from sysid_btr.models.builtin import load_robot
    from sysid_btr.models.robot import joint_names, joint_ranges

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
        from sysid_btr.display.text import console, problems_table

        out = console(sys.stdout)
        for path, problems in found.items():
            errors = len(errors_of(problems))
            warnings = len(problems) - errors
            out.print(f"{path}: {_count(errors, 'error')}, {_count(warnings, 'warning')}")
            if problems:
                out.print(problems_table(problems))
    if any(errors_of(problems) for problems in found.values()):
        raise typer.Exit(LogError.exit_code)


@app.command("import")
def import_(
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="FILE...", help="Foreign logs, or folders of bags and datasets.")
    ] = None,
    format_: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="NAME",
            help="auto (by content), naoqi, ros2, mcap, lerobot, csv (also Parquet), or one installed.",
        ),
    ] = "auto",
    mapping: Annotated[
        Path | None,
        typer.Option("--map", metavar="FILE", help="Mapping (TOML): columns, units, joints, topics, metadata."),
    ] = None,
    model: Model = None,
    rename: Annotated[
        list[str] | None,
        typer.Option("--rename", metavar="A=B", help="Joint A of the file is joint B of the model; repeatable."),
    ] = None,
    unit: Annotated[
        list[str] | None,
        typer.Option(
            "--unit", metavar="CHANNEL=UNIT", help="e.g. position=deg, time=ms, velocity.knee=rpm; repeatable."
        ),
    ] = None,
    mount: Annotated[
        str | None, typer.Option("--mount", metavar="fixed|free", help="Whether the torso was held or could move.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="The log to write (Parquet); without it nothing is written."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file at --out.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write the log although the validation finds errors, to repair it.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was found as JSON.")] = False,
    debug: Debug = False,
) -> None:
    """Make logs of other formats ones of this program, and check them; several files are episodes of one log.

    Every column or topic that is not understood is told. A table whose columns cannot be guessed gets a mapping
    file on standard output, to fill in. With errors in it the log is not written (exit 3), unless --force is given.
    """
    from sysid_btr.importing import known_model
    from sysid_btr.io.importers.base import MappingNeeded
    from sysid_btr.io.importers.mapping import read_map, with_flags
    from sysid_btr.io.importers.run import import_log
    from sysid_btr.request import output_file, pairs

    target = output_file(out, files or [], overwrite)
    known = known_model(model)
    told = with_flags(
        read_map(mapping),
        units=pairs("--unit", unit),
        renames=pairs("--rename", rename),
        meta={"mount": mount},
    )
    try:
        imported = import_log(files or [], importer=format_, told=told, model=known)
    except MappingNeeded as error:
        proposed = error.propose(known.joints if known else None)
        if as_json:
            _print_json({"mapping": proposed})
        else:
            sys.stdout.write(proposed)
        raise
    for text in imported.remarks:
        remark(text)
    wanted = imported.usable or force
    if target is not None and wanted:
        from sysid_btr.io.parquet import write_log

        write_log(imported.log, target, overwrite=overwrite)
    written = target if wanted else None
    if as_json:
        from sysid_btr.report.imported import as_json as to_dict

        _print_json(to_dict(imported, written))
    else:
        from sysid_btr.display.text import console, problems_table
        from sysid_btr.report.imported import summary

        screen = console(sys.stdout)
        for line in summary(imported):
            screen.print(line)
        if imported.problems:
            screen.print(problems_table(imported.problems))
    if written is not None:
        remark(f"log: {written}")
    elif target is None:
        remark("nothing is written without --out")
    if imported.advice:
        remark(f"what may put it right (check each): {' '.join(imported.advice)}")
    if not imported.usable:
        remark("the log has errors" + (", and is written all the same" if written else ": it is not written"))
        raise typer.Exit(LogError.exit_code)


@app.command()
def init(
    files: Annotated[list[Path] | None, typer.Argument(metavar="LOG...", help="Logs of one robot.")] = None,
    model: Model = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="The study file to write; without it, standard output."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file at --out.")] = False,
    debug: Debug = False,
) -> None:
    """Write a study file to begin with: what the log holds, and what of the model it may tell, line by line.

    It runs as it is: sysid-btr fit --config FILE, or close --config FILE.
    """
    from sysid_btr.identify.study_file import study_file
    from sysid_btr.request import output_file, warn_of

    robot = find_robot(model, None)
    logs = read_logs(files)
    target = output_file(out, files or [], overwrite)
    warn_of(robot, logs)
    text = study_file(robot, logs, model or robot.name, target)
    if target is None:
        sys.stdout.write(text)
        return
    Folder(target.parent).write(target.name, text)
    remark(f"study file: {target}; next: sysid-btr close --config {target}")


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
    params: Params = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder for the predicted logs.")
    ] = None,
    overwrite: Overwrite = False,
    threads: Threads = 0,
    as_json: Json = False,
    config: Config = None,
    debug: Debug = False,
) -> None:
    """Give the log's commands to the model and compare its sensors with the log's; nothing is fitted.

    A motion that was not recorded yet (excite.parquet) is only played: where every joint goes, and the predicted log.
    """
    from sysid_btr.identify.outcome import replay_result
    from sysid_btr.identify.replay import replay_log, set_parameters
    from sysid_btr.identify.scores import score_problem
    from sysid_btr.identify.study import make_study
    from sysid_btr.objectives.targets import COMPARED

    began = time.perf_counter()
    robot = find_robot(model, None)
    logs = read_logs(log, motions=True)
    parameters = dict(assignments("--set", set_))
    changed = set_parameters(robot, parameters)
    numerics = None
    if params is not None:
        changed, numerics = with_params(params, robot, changed)
    targets = replay_targets(out, logs, overwrite)
    if any(one.is_motion for one in logs):
        _rehearse(robot, logs, changed, numerics, targets, overwrite, threads, as_json)
        return
    study = make_study(robot, logs, holdout=logs, channels=COMPARED, numerics=numerics, threads=threads)
    scores = score_problem(study.train_problem(changed), changed.values)
    for path, one in zip(targets, logs, strict=False):
        from sysid_btr.io.parquet import write_log

        predicted = replay_log(robot, one, changed, numerics=study.numerics, threads=threads)
        write_log(predicted, path, overwrite=overwrite)
    result = replay_result(study, scores, parameters, time.perf_counter() - began)
    if as_json:
        _print_json(result)
        return
    from sysid_btr.display.text import console, joints_table, show

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
    params: Params = None,
    bounds: Bounds = None,
    channels: Channels = None,
    estimator: EstimatorName = "lsq",
    distance: DistanceName = "likelihood",
    max_evaluations: MaxEvaluations = None,
    profile: Profiles = None,
    seed: Seed = 0,
    threads: Threads = 0,
    executor: ExecutorPlace = None,
    out: Out = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    render: Render = False,
    as_json: Json = False,
    config: Config = None,
    debug: Debug = False,
) -> None:
    """Fit parameters of the model to the log: values, intervals, error before and after on held-out data.

    Exit 5 if the search did not converge or the log tells none of the parameters; the results are written all
    the same.
    """
    from sysid_btr.identify.profile import chosen_names, with_profiles

    robot = find_robot(model, bounds)
    if not free:
        raise UsageError(what_can_be_freed(robot))
    search = _search(estimator, distance, max_evaluations, robot, start, params)
    request = Request(
        "fit",
        robot,
        read_logs(log),
        holdout,
        free,
        channels,
        threads,
        seed,
        {
            "estimator": estimator,
            "distance": distance,
            "start": start or [],
            "bounds": bounds or [],
            "params": params_digest(params),
        },
        executor,
    )
    keeper = Keeper.open(out, resume, overwrite, request)
    _check_render(render, keeper)

    def job(study: Study, progress: ProgressLine) -> Fit:
        terms = study.declare(free)
        wanted = chosen_names(terms.names, profile or [])
        return with_profiles(search(study, terms, _generator(seed), keeper.journal, progress), wanted, progress)

    _finish(request, keeper, job, as_json, render)


@app.command()
def posterior(
    model: Model = None,
    log: Logs = None,
    free: Free = None,
    holdout: Holdout = None,
    start: Starts = None,
    params: Params = None,
    bounds: Bounds = None,
    priors: Priors = None,
    channels: Channels = None,
    estimator: EstimatorName = "lsq",
    distance: DistanceName = "likelihood",
    ensembles: Annotated[
        int, typer.Option("--ensembles", min=2, help="Independent ensembles; they must agree.")
    ] = 2,
    walkers: Annotated[
        int | None, typer.Option("--walkers", min=1, help="Of each ensemble, even. [default: 2 (parameters + 1)]")
    ] = None,
    max_evaluations: Annotated[
        int | None,
        typer.Option(
            "--max-evaluations", min=1, help="Stop sampling after this many replays, converged or not. [default: 20000]"
        ),
    ] = None,
    seed: Seed = 0,
    threads: Threads = 0,
    executor: ExecutorPlace = None,
    out: Out = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    render: Render = False,
    as_json: Json = False,
    config: Config = None,
    debug: Debug = False,
) -> None:
    """Fit, then draw the posterior of the parameters with real replays, until independent ensembles agree.

    Writes posterior.nc (ArviZ), a corner plot, traces and predictions of held-out data with their bands. Exit 5 if
    it has not converged when the replays are used up; the results are written all the same.
    """
    from sysid_btr.estimators.base import Budget
    from sysid_btr.estimators.ensemble import walkers_for
    from sysid_btr.posterior.draw import BUDGET
    from sysid_btr.posterior.draw import posterior as draw_posterior
    from sysid_btr.posterior.export import check_installed
    from sysid_btr.posterior.priors import choose_priors
    from sysid_btr.posterior.sampling import Settings

    check_installed()
    robot = find_robot(model, bounds)
    if not free:
        raise UsageError(what_can_be_freed(robot))
    search = _search(estimator, distance, None, robot, start, params)
    believed = dict(pairs("--priors", priors))
    settings = Settings(ensembles=ensembles, walkers=walkers)
    request = Request(
        "posterior",
        robot,
        read_logs(log),
        holdout,
        free,
        channels,
        threads,
        seed,
        {
            "estimator": estimator,
            "distance": distance,
            "start": start or [],
            "bounds": bounds or [],
            "params": params_digest(params),
            "priors": believed,
            "ensembles": ensembles,
            "walkers": walkers,
        },
        executor,
    )
    keeper = Keeper.open(out, resume, overwrite, request)
    _check_render(render, keeper)

    def job(study: Study, progress: ProgressLine) -> Posterior:
        terms = study.declare(free)
        choose_priors(terms.parameters, believed, robot.priors)
        walkers_for(len(terms.parameters), walkers)
        rng = _generator(seed)
        return draw_posterior(
            search(study, terms, rng, keeper.journal, progress),
            priors=believed,
            settings=settings,
            rng=rng,
            budget=BUDGET if max_evaluations is None else Budget(evaluations=max_evaluations),
            journal=keeper.journal.section(),
            progress=progress,
        )

    _finish(request, keeper, job, as_json, render)


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
    params: Params = None,
    bounds: Bounds = None,
    channels: Channels = None,
    seed: Seed = 0,
    threads: Threads = 0,
    executor: ExecutorPlace = None,
    out: Out = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    render: Render = False,
    as_json: Json = False,
    config: Config = None,
    debug: Debug = False,
) -> None:
    """Find what the model is missing: fit the parameters, trace what is left to an effect, add it, refit.

    Shows the held-out error before and after.

    Without --fit all masses and the common servo gains are freed, so that a wrong mass does not pass for an
    effect.
    """
    from sysid_btr.terms.library import select_effects

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
        {"effects": names, "bounds": bounds or [], "params": params_digest(params)},
        executor,
    )
    keeper = Keeper.open(out, resume, overwrite, request)
    _check_render(render, keeper)
    _finish(request, keeper, _closing_job(parameters, names, seed, keeper, params), as_json, render)


@app.command()
def btr(
    model: Model = None,
    free: Free = None,
    robot_sim: Annotated[
        str | None,
        typer.Option("--robot-sim", metavar="NAME|FILE", help="A simulation that stands for the robot, unseen."),
    ] = None,
    robot_set: Annotated[
        list[str] | None,
        typer.Option(
            "--robot-set", metavar="PARAMETERS=VALUE", help="Change that simulation, e.g. 'mass:*=1.1'; repeatable."
        ),
    ] = None,
    exchange: Annotated[
        Path | None,
        typer.Option(
            "--exchange", metavar="DIR", help="A real robot: commands to play appear here, recordings are waited for."
        ),
    ] = None,
    wait: Annotated[
        float | None,
        typer.Option("--wait", metavar="S", help="Give up waiting for a recording after so long. [default: never]"),
    ] = None,
    iterations: Annotated[int, typer.Option("--iterations", min=1, help="At most.")] = 13,
    trials: Annotated[
        int | None,
        typer.Option("--trials", min=1, help="Trials on the robot in each iteration. [default: 12; 2 without phi1]"),
    ] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="Of a trial. [default: 3 for the ant, else 8]")
    ] = None,
    distance: Annotated[
        str,
        typer.Option(
            "--distance",
            metavar="NAME",
            help="By which models are judged: phi1, phi2[:BINS], mse, wasserstein, likelihood.",
        ),
    ] = "phi1",
    choice: Annotated[
        str, typer.Option("--choice", metavar="NAME", help="Of the trials: fittest, or disagreement among models.")
    ] = "fittest",
    search: Annotated[
        str, typer.Option("--search", metavar="NAME", help="For controllers: ga (the paper) or cmaes.")
    ] = "ga",
    model_search: Annotated[
        str | None,
        typer.Option(
            "--model-search",
            metavar="NAME",
            help="For models: cmaes, ga (the paper), or lsq, which looks at the trials' first 2 s. "
            "[default: lsq for a likelihood, else cmaes]",
        ),
    ] = None,
    requirement: Annotated[
        float | None, typer.Option("--requirement", metavar="M/S", help="Stop once the robot walks this fast.")
    ] = None,
    close: Annotated[
        bool, typer.Option("--close", help="Look for missing effects where no model explains the robot's logs.")
    ] = False,
    bounds: Bounds = None,
    seed: Seed = 0,
    threads: Threads = 0,
    out: Out = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    as_json: Json = False,
    config: Config = None,
    debug: Debug = False,
) -> None:
    """Back to Reality: search a controller in the model, try it on the robot, correct the model by that, again.

    The robot is a simulation that the search does not see (--robot-sim), or a real one behind a folder (--exchange).
    Exit 5 if model and robot lost hold of each other; the results are written all the same.
    """
    from sysid_btr.btr.command import Asked, run_btr
    from sysid_btr.result import exit_code

    asked = Asked(
        find_robot(model, bounds),
        free or [],
        robot_sim,
        dict(assignments("--robot-set", robot_set)),
        exchange,
        wait,
        iterations,
        trials,
        duration,
        distance,
        choice,
        search,
        model_search,
        requirement,
        close,
        seed,
        threads,
    )
    result = run_btr(asked, out, resume, overwrite)
    if as_json:
        _print_json(result)
    else:
        from sysid_btr.display.text import console, show

        show(result, console(sys.stdout))
    if exit_code(result):
        raise typer.Exit(exit_code(result))


@app.command()
def excite(
    model: Model = None,
    free: Free = None,
    log: Logs = None,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="Length of the motion.")] = 10.0,
    rate: Annotated[float, typer.Option("--rate", metavar="HZ", help="Samples a second.")] = 100.0,
    noise: Annotated[
        float | None,
        typer.Option(
            "--noise",
            metavar="RAD",
            help="Noise floor of the position sensors (rad, m). [default: the log's, else that of a 12-bit encoder]",
        ),
    ] = None,
    joints: Annotated[
        list[str] | None,
        typer.Option("--joints", metavar="GLOB[,GLOB..]", help="Joints that move. [default: all with a servo]"),
    ] = None,
    margin: Annotated[
        float, typer.Option("--margin", metavar="FRACTION", help="Of each joint's range, left free at either end.")
    ] = 0.05,
    max_velocity: Annotated[
        float | None,
        typer.Option("--max-velocity", metavar="V", help="Of every joint. [default: 6 rad/s; slides 0.3 m/s]"),
    ] = None,
    max_acceleration: Annotated[
        float | None,
        typer.Option(
            "--max-acceleration",
            metavar="A",
            help="Of every joint; less where the model limits a servo's torque. [default: 60 rad/s^2; slides 3 m/s^2]",
        ),
    ] = None,
    criterion: Annotated[
        str,
        typer.Option(
            "--criterion", metavar="NAME", help="mean (of the standard errors) or logdet (volume of the ellipsoid)."
        ),
    ] = "mean",
    estimator: Annotated[
        str, typer.Option("--estimator", metavar="NAME", help="Of the search: cmaes, ga, nlopt:ALGORITHM.")
    ] = "cmaes",
    max_evaluations: Annotated[int, typer.Option("--max-evaluations", min=1, help="Motions that are tried.")] = 400,
    bounds: Bounds = None,
    seed: Seed = 0,
    threads: Threads = 0,
    out: Out = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    as_json: Json = False,
    config: Config = None,
    debug: Debug = False,
) -> None:
    """Design a motion that tells chosen parameters best, with the intervals to expect before and after.

    Writes excite.parquet, a log of commands to play on the robot (its torso held), result.json and a figure. What is
    before is the motion of --log, which also tells the noise of the sensors, or else the first motion of the search.
    Only the limits of the joints keep the motion from hitting the robot itself or the ground.
    """
    from sysid_btr.estimators.base import Budget
    from sysid_btr.excite import outcome
    from sysid_btr.excite.design import design, find_criterion, find_estimator
    from sysid_btr.result import exit_code

    robot = find_robot(model, bounds)
    if not free:
        raise UsageError(what_can_be_freed(robot))
    if out is None:
        raise UsageError("where shall the motion go? Give --out DIR")
    if log and len(log) > 1:
        raise UsageError("a motion is compared with one reference: give --log once")
    reference = read_logs(log)[0] if log else None
    asked: dict[str, Any] = {
        "seconds": seconds,
        "rate": rate,
        "noise": noise,
        "joints": split_names(joints),
        "margin": margin,
        "velocity": max_velocity,
        "acceleration": max_acceleration,
    }
    chosen, score = find_estimator(estimator), find_criterion(criterion)
    settings = {**asked, "estimator": estimator, "criterion": criterion, "bounds": bounds or []}
    logs = [reference] if reference is not None else []
    request = Request("excite", robot, logs, None, free, None, threads, seed, settings)
    keeper = Keeper.open(out, resume, overwrite, request)
    assert keeper.folder is not None
    with ProgressLine("excite") as progress:
        try:
            found = design(
                robot,
                free,
                reference=reference,
                **asked,
                criterion=score,
                estimator=chosen,
                rng=_generator(seed),
                budget=Budget(evaluations=max_evaluations),
                journal=keeper.journal,
                progress=progress,
                threads=threads,
                search_context=outcome.first_interrupt_ends_the_search,
            )
        except Interrupted:
            raise InterruptedRun(_interrupted(keeper, progress)) from None
    result = outcome.make_result(found, seed=seed)
    remark(f"report: {outcome.write_all(keeper.folder, found, result)}")
    if as_json:
        _print_json(result)
    else:
        from sysid_btr.display.text import console

        screen = console(sys.stdout)
        for part in outcome.show(result):
            screen.print(part)
    remark(f"motion: {keeper.folder.path / outcome.MOTION}. {outcome.WARNING}")
    if outcome.interrupted(found):
        raise InterruptedRun(
            "interrupted; the best motion so far is written, and the same command with --resume goes on searching"
        )
    code = exit_code(result)
    if code:
        raise typer.Exit(code)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The --out folder of a finished run.")],
    debug: Debug = False,
) -> None:
    """Write report.html again from result.json and the pictures of a finished run of any verb."""
    from sysid_btr.report.pictures import write_report
    from sysid_btr.result import read_result

    sys.stdout.write(f"{write_report(Folder(folder), read_result(folder))}\n")


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


def _search(
    estimator: str,
    distance: str,
    max_evaluations: int | None,
    robot: Robot,
    start: list[str] | None,
    params: Path | None,
) -> Callable[[Study, Terms, Any, Journal, ProgressLine], Fit]:
    """A fit as the flags ask for it, of whatever study."""
    from sysid_btr.estimators import get_estimator
    from sysid_btr.estimators.base import Budget
    from sysid_btr.identify.fit import fit as fit_study
    from sysid_btr.objectives.distance import get_distance

    chosen, wanted = get_estimator(estimator), get_distance(distance)

    def search(study: Study, terms: Terms, rng: Any, journal: Journal, progress: ProgressLine) -> Fit:
        parameters = terms.parameters
        return fit_study(
            study,
            terms,
            estimator=chosen,
            rng=rng,
            budget=Budget(evaluations=max_evaluations),
            journal=journal,
            progress=progress,
            start=start_values(parameters, [*known_starts(params, robot, parameters), *(start or [])]),
            distance=wanted,
        )

    return search


def _closing_job(
    parameters: list[str], effects: list[str], seed: int, keeper: Keeper, params: Path | None = None
) -> Job:
    def job(study: Study, progress: ProgressLine) -> Closing:
        from sysid_btr.diagnosis.close import close as close_loop

        terms = study.declare(parameters)
        free = terms.parameters
        return close_loop(
            study,
            terms,
            start=start_values(free, known_starts(params, study.robot, free)),
            effects=tuple(effects),
            rng=_generator(seed),
            journal=keeper.journal,
            progress=progress,
        )

    return job


def _rehearse(
    robot: Robot,
    motions: Sequence[Log],
    chosen: TermModel,
    numerics: Numerics | None,
    targets: Sequence[Path],
    overwrite: bool,
    threads: int,
    as_json: bool,
) -> None:
    """Play motions in the model; say how far every joint goes."""
    from itertools import zip_longest

    from sysid_btr.display.text import console
    from sysid_btr.identify.replay import replay_log
    from sysid_btr.io.parquet import write_log
    from sysid_btr.report.motion import reach, reach_table

    if not all(one.is_motion for one in motions):
        raise UsageError("--log: motions to be played and recordings; give one or the other")
    found = {}
    for path, one in zip_longest(targets, motions):
        predicted = replay_log(robot, one, chosen, numerics=numerics, threads=threads)
        found[str(one.path)] = reach(robot, one, predicted)
        if path is not None:
            write_log(predicted, path, overwrite=overwrite)
    if as_json:
        _print_json(found)
    else:
        screen = console(sys.stdout)
        for name, joints in found.items():
            screen.print(f"{name}: a motion that was not recorded: played in the model, with nothing to compare")
            screen.print(reach_table(joints))
    for path in targets:
        remark(f"predicted log: {path}")


def _check_render(wanted: bool, keeper: Keeper) -> None:
    if wanted and keeper.folder is None:
        raise UsageError("--render writes pictures: give an --out folder for them")


def _draw(folder: Folder, outcome: Fit | Closing, result: dict[str, Any]) -> None:
    from sysid_btr.report.pictures import rewrite
    from sysid_btr.report.render import CannotRenderError, save_pictures

    try:
        pictures = save_pictures(folder, outcome)
    except CannotRenderError as error:
        remark(
            f"no pictures: nothing here draws off-screen ({error}). Install a software driver (Debian, Ubuntu: "
            "libegl1 and libgl1-mesa-dri, or libosmesa6) or name a working one in MUJOCO_GL; all else is written."
        )
        return
    remark(f"pictures: {', '.join(map(str, pictures))}")
    rewrite(folder, result, pictures[0].name)


def _finish(request: Request, keeper: Keeper, job: Job, as_json: bool, render: bool = False) -> None:
    code = _run(request, keeper, job, as_json, render)
    if code:
        raise typer.Exit(code)


def _run(request: Request, keeper: Keeper, job: Job, as_json: bool, render: bool = False) -> int:
    """Do the work, write and print what it found; the exit code."""
    from sysid_btr.executors import open_executor
    from sysid_btr.result import exit_code
    from sysid_btr.writeback.write import describe_model

    began = time.perf_counter()
    with ProgressLine(request.kind) as progress, open_executor(request.executor) as executor:
        try:
            outcome = job(request.study(executor), progress)
        except Interrupted:
            raise InterruptedRun(_interrupted(keeper, progress)) from None
        except LostCluster as lost:
            raise InterruptedRun(f"{lost}\n{_interrupted(keeper, progress)}") from None
    result = outcome.to_dict(seed=request.seed, wall_s=time.perf_counter() - began)
    if keeper.folder is not None:
        page = write_all(keeper.folder, outcome, result)
        remark(f"report: {page}")
        if render:
            _draw(keeper.folder, as_model(outcome), result)
    else:
        describe_model(as_model(outcome), result)
    if as_json:
        _print_json(result)
    else:
        from sysid_btr.display.text import console, show

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
