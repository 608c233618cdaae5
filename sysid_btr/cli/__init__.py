"""The command line."""

from sysid_btr.cli.commands import EXIT_CODES as EXIT_CODES
from sysid_btr.cli.commands import app as app
from sysid_btr.cli.commands import main as main
from sysid_btr.cli.commands import run as run
