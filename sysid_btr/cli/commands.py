"""The command line: ``sysid-btr VERB``. Results go to stdout, progress and remarks to stderr."""

from __future__ import annotations

import errno
import inspect
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NoReturn, get_type_hints

import typer

from sysid_btr.cli.btr import btr
from sysid_btr.cli.check import check
from sysid_btr.cli.close import close
from sysid_btr.cli.compare import compare
from sysid_btr.cli.demo import demo
from sysid_btr.cli.excite import excite
from sysid_btr.cli.fit import fit
from sysid_btr.cli.import_ import import_
from sysid_btr.cli.init import init
from sysid_btr.cli.options import Option, Options, options_of
from sysid_btr.cli.posterior import posterior
from sysid_btr.cli.replay import replay
from sysid_btr.cli.report import report
from sysid_btr.cli.study_file import read_study_file
from sysid_btr.cli.terminal import hang_up, open_streams, remark
from sysid_btr.cli.validate import validate
from sysid_btr.errors import InterruptedRun, SysidError, UsageError
from sysid_btr.progress import Interrupted, interruptible

EXIT_CODES = """\b
Exit codes:
  0    done
  1    a defect of this program
  2    usage
  3    a log cannot be used
  4    the model cannot be used or does not fit the log
  5    finished and written, but the fit did not converge or no parameter is identifiable
  130  interrupted; the journal is kept, and --resume continues
  141  the reader of the output closed it
"""
OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM)
"""What the system says where something cannot be written."""
UNREAD = 128 + 13
"""Exit code where nobody reads the output, as a shell has it of a process that SIGPIPE ended."""
STUDIED = (validate, check, replay, fit, posterior, close, btr, excite)
"""Verbs that take a study file."""
VERBS: tuple[Callable[[Any], int], ...] = (
    validate,
    import_,
    init,
    check,
    replay,
    fit,
    posterior,
    close,
    btr,
    excite,
    compare,
    report,
    demo,
)
"""In the order of the help."""


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and end the process with its exit code."""
    # threads of linear algebra spin beside those that simulate: a third of the CPU time of `close` on a TX40
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    open_streams()
    try:
        code = run(sys.argv[1:] if argv is None else argv)
        sys.stdout.flush()
    except BrokenPipeError:  # who read it has seen enough: `validate log | head -1`
        hang_up()
        code = UNREAD
    except OSError as error:
        hang_up()
        code = _explain(error)
    sys.exit(code)


def run(argv: Sequence[str]) -> int:
    """Run the command line; the exit code. No error reaches the user as a traceback."""
    try:
        with interruptible():
            _program()(list(argv), prog_name="sysid-btr")
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):
            raise end.__context__ from None
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
    except BrokenPipeError:
        raise
    except MemoryError as error:
        remark(f"error: there is not enough memory{f' ({error})' if str(error) else ''}: use fewer or shorter logs")
        return UsageError.exit_code
    except Exception as error:
        if "--debug" in argv:
            raise
        return _explain(error)
    return 0


@cache
def _program() -> Callable[..., Any]:
    """The command line, made of its verbs once in a process."""
    return typer.main.get_command(app)


def _explain(error: Exception) -> int:
    """Say what an error means that is no mistake of the user's; the exit code."""
    if isinstance(error, OSError) and error.errno in OF_THE_DISK:
        where = f" {error.filename}" if error.filename else ""
        remark(f"error: cannot write{where}: {error.strerror}; free some space, or choose a writable folder")
        return UsageError.exit_code
    if isinstance(error, OSError) and error.filename:
        remark(f"error: {str(error.filename)[:200]}: {error.strerror}; check the path")
        return UsageError.exit_code
    remark(
        f"internal error: {type(error).__name__}: {error}\n"
        "This is a defect of sysid-btr, not of your data. Run the command again with --debug and report "
        "what it prints, with the output of `sysid-btr --version`, to the project's issue tracker."
    )
    return 1


def options_class(verb: Callable[[Any], int]) -> type[Options]:
    """What a verb is given."""
    kind: type[Options] = get_type_hints(verb)["options"]
    return kind


@cache
def study_options() -> Mapping[str, Option]:
    """Everything that a study file may hold, by name."""
    known: dict[str, Option] = {}
    for verb in STUDIED:
        known |= {name: o for name, o in options_of(options_class(verb)).items() if not o.positional}
    return known


def _command(verb: Callable[[Any], int]) -> Callable[..., None]:
    """A verb as typer wants it: a function with a parameter for each option."""
    kind = options_class(verb)
    known = options_of(kind)

    def call(**given: Any) -> None:
        said = {name: given[name] for name in known if given[name] is not None and given[name] != []}
        code = verb(kind(**{name: known[name].kind.value(known[name].flag, value) for name, value in said.items()}))
        if code:
            raise typer.Exit(code)

    extra = [CONFIG, DEBUG] if verb in STUDIED else [DEBUG]
    call.__signature__ = inspect.Signature([*(o.parameter() for o in known.values()), *extra])  # type: ignore[attr-defined]
    call.__doc__ = verb.__doc__
    return call


def _read_config(context: typer.Context, path: Path | None) -> Path | None:
    if path is not None:
        known = {p.name for p in context.command.params}
        given = read_study_file(path, study_options())
        context.default_map = {name: value for name, value in given.items() if name in known}
    return path


def _print_versions(wanted: bool) -> None:
    if wanted:
        from sysid_btr.result import versions

        sys.stdout.write(", ".join(f"{name} {version}" for name, version in versions().items()) + "\n")
        raise typer.Exit


CONFIG = inspect.Parameter(
    "config",
    inspect.Parameter.KEYWORD_ONLY,
    default=None,
    annotation=Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            is_eager=True,
            callback=_read_config,
            help="Study file (TOML): any flag of any verb as `name = value`; flags given here win.",
        ),
    ],
)
DEBUG = inspect.Parameter(
    "debug",
    inspect.Parameter.KEYWORD_ONLY,
    default=False,
    annotation=Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")],
)
app = typer.Typer(
    name="sysid-btr",
    help="Make a MuJoCo model move like the robot in a log: which parameters, how certain, what is missing.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
for _verb in VERBS:
    app.command(_verb.__name__.rstrip("_"))(_command(_verb))


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_versions, is_eager=True, help="Print versions and exit.")
    ] = False,
) -> None:
    pass
