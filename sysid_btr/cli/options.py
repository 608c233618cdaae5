"""One declaration for every option: the command line, the study file, the fingerprint of a journal and the call from
Python derive from it.

The options of a verb are a frozen dataclass; its fields are made by `option` or `argument`. Its command line has the
flag ``--max-evaluations`` for the field ``max_evaluations``, a study file the key ``max_evaluations``.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, get_origin, get_type_hints

from sysid_btr.cli.kinds import KINDS, TEXT, Kind
from sysid_btr.errors import UsageError


@dataclass(frozen=True)
class Option:
    """How an option is given, and what it is for.

    Attributes
    ----------
    help : a phrase of its own.
    decides : whether it decides which candidates are evaluated, and so belongs to the fingerprint of the journal.
    metavar : what stands for its value in the help.
    short : a flag of one letter.
    least : smallest number allowed.
    otherwise : what is done where nothing is said, if the default does not show it.
    beside : whether it names files, which are looked for beside the study file first.
    positional : whether it has no flag.
    name, kind, default : of the field.
    """

    help: str
    decides: bool
    metavar: str | None = None
    short: str | None = None
    least: int | None = None
    otherwise: str = ""
    beside: bool = False
    positional: bool = False
    name: str = ""
    kind: Kind = TEXT
    default: Any = None

    @property
    def flag(self) -> str:
        """At the command line."""
        return "--" + self.name.replace("_", "-")

    @property
    def repeatable(self) -> bool:
        """Whether the flag may be given more than once."""
        return get_origin(self.kind.typed) is list

    @property
    def required(self) -> bool:
        """Whether there is no default."""
        return self.default is ...

    def parameter(self) -> inspect.Parameter:
        """The parameter of a function that typer makes this option of."""
        import typer

        if self.positional:
            how = typer.Argument(metavar=self.metavar, help=self.help)
        else:
            words = f"{self.help} Repeatable." if self.repeatable else self.help
            words += f" [default: {self.otherwise}]" if self.otherwise else ""
            switch = f"{self.flag}/--no-{self.flag[2:]}" if self.default is True else self.flag
            names = [switch, self.short] if self.short else [switch]
            how = typer.Option(
                *names, metavar=self.metavar, min=self.least, help=words, show_default=not self.otherwise
            )
        typed, default = self.kind.typed, self.default
        if self.required:
            default = inspect.Parameter.empty
        elif default is None or default == () or default == {}:
            typed, default = typed | None, None
        else:
            default = self.kind.given(default)
        return inspect.Parameter(
            self.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[typed, how]
        )


def option(
    default: Any,
    help: str,
    *,
    decides: bool,
    metavar: str | None = None,
    short: str | None = None,
    least: int | None = None,
    otherwise: str = "",
    beside: bool = False,
) -> Any:
    """A field of a verb's options that has a flag; see `Option`.

    `decides` has no default: whoever adds an option has to say whether it changes what is searched.
    """
    declared = Option(help, decides, metavar, short, least, otherwise, beside)
    if isinstance(default, dict):
        return field(default_factory=lambda: dict(default), metadata={"option": declared})
    return field(default=default, metadata={"option": declared})


def argument(default: Any, help: str, *, metavar: str) -> Any:
    """A field of a verb's options that is given without a flag; ``...`` where it must be."""
    metadata = {"option": Option(help, False, metavar, positional=True)}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a verb.

    Raises
    ------
    UsageError
        For a number that is less than is allowed, or not finite.
    """

    def __post_init__(self) -> None:
        for one in options_of(type(self)).values():
            value = getattr(self, one.name)
            if isinstance(value, float) and not math.isfinite(value):
                raise UsageError(f"{one.flag} {value}: give a finite number")
            if one.least is not None and value is not None and value < one.least:
                raise UsageError(f"{one.flag} {value}: give at least {one.least}")


@dataclass(frozen=True, kw_only=True)
class RunOptions(Options):
    """Options that say how something is run and what it writes; in the help they come last."""


def options_of(kind: type[Options]) -> Mapping[str, Option]:
    """The options of a verb by name, in the order of its help."""
    types = get_type_hints(kind, include_extras=True)
    by_name = {f.name: f for f in fields(kind)}
    return {name: _named(by_name[name], types[name]) for name in _ordered(kind)}


def _ordered(kind: type) -> list[str]:
    """Names of fields: those of the groups that a verb lists, then its own, then how it is run."""
    owners: dict[str, type] = {}
    for name, owner in _owners(kind):
        owners.setdefault(name, owner)
    return sorted(owners, key=lambda n: 1 if owners[n] is kind else 2 * issubclass(owners[n], RunOptions))


def _owners(kind: type) -> Iterator[tuple[str, type]]:
    for base in kind.__bases__:
        yield from _owners(base)
    yield from ((name, kind) for name in inspect.get_annotations(kind))


def _named(one: Any, typed: Any) -> Option:
    default = one.default
    if one.default_factory is not MISSING:
        default = one.default_factory()
    elif default is MISSING:
        default = ...
    declared: Option = one.metadata["option"]
    return replace(declared, name=one.name, kind=KINDS[typed], default=default)


def deciding(options: Options) -> dict[str, Any]:
    """What decides which candidates are evaluated, as JSON: files by the digest of what they hold."""
    named = options_of(type(options)).values()
    return {one.name: _content(getattr(options, one.name)) for one in named if one.decides}


def _content(value: Any) -> Any:
    from sysid_btr.io.parquet import sha256
    from sysid_btr.run_folder import PARAMS

    if isinstance(value, Path):
        file = value / PARAMS if value.is_dir() else value
        return sha256(file) if file.is_file() else str(value)
    if isinstance(value, tuple):
        return [_content(v) for v in value]
    # of two globs that hold a name the later counts
    return [[k, _content(v)] for k, v in value.items()] if isinstance(value, Mapping) else value
