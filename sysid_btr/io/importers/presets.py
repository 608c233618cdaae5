"""Presets: mapping files for the layouts that drivers and recorders of common robots write.

Each is a file in ``preset_maps/``, in the words of a mapping file; its first line is its title.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from sysid_btr.errors import UsageError

FOLDER = Path(__file__).parent / "preset_maps"


@cache
def available_presets() -> tuple[str, ...]:
    """Names of the presets."""
    return tuple(sorted(file.stem for file in FOLDER.glob("*.toml")))


def preset_text(name: str) -> str:
    """A preset as a mapping file, to print, copy and alter.

    Raises
    ------
    UsageError
        If there is none of this name.
    """
    if name not in available_presets():
        from difflib import get_close_matches

        close = get_close_matches(name.lower(), available_presets(), n=1, cutoff=0.4)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise UsageError(f"unknown preset {name!r}; {hint}available: {', '.join(available_presets())}")
    return (FOLDER / f"{name}.toml").read_text(encoding="utf-8")


def preset_title(name: str) -> str:
    """What a preset is for, in a phrase."""
    return preset_text(name).partition("\n")[0].removeprefix("# ")
