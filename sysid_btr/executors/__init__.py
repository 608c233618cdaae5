"""Replays on the workers of a dask cluster: `open_executor` gives what a study takes as its `executor`."""

from sysid_btr.executors.place import caution, open_executor

__all__ = ["caution", "open_executor"]
