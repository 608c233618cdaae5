"""``python -m sysid_btr.cli``."""

from sysid_btr.cli.commands import main

if __name__ == "__main__":
    main()
