"""Errors a user can meet; each carries the exit code the command line ends with."""

from __future__ import annotations


class SysidError(Exception):
    """Base of all errors meant for the user: the message says what, where, what is allowed, what next."""

    exit_code: int = 1


class UsageError(SysidError):
    """A flag, parameter expression, study file or output folder that cannot be used."""

    exit_code = 2


class LogError(SysidError):
    """A log that cannot be read, or that violates the schema."""

    exit_code = 3


class ModelError(SysidError):
    """A model that cannot be built, or that does not fit the log."""

    exit_code = 4


class NotConvergedError(SysidError):
    """The work finished and its results are written, but they did not converge or are not identifiable."""

    exit_code = 5


class InterruptedRun(SysidError):
    """The user stopped the work; the journal and the best answer so far are kept."""

    exit_code = 130


class LostCluster(InterruptedRun):
    """The machines that simulate are gone; what was simulated before is in the journal, if one is kept."""
