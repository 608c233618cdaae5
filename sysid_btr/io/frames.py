"""Columns of pandas DataFrames as arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray

if TYPE_CHECKING:
    import pandas as pd

CLOCK = "time"


def with_time(table: pd.DataFrame) -> pd.DataFrame:
    """The table with column ``time`` where its index is the clock: named so, or of dates or durations."""
    import pandas as pd

    index = table.index
    named = str(index.name) == CLOCK or isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex)
    if CLOCK in table.columns or not named:
        return table
    clock = index.total_seconds() if isinstance(index, pd.TimedeltaIndex) else index
    return table.set_axis(range(len(table)), axis=0).assign(**{CLOCK: np.asarray(clock)})


def seconds(column: pd.Series[Any]) -> FloatArray | None:
    """A clock in s: numbers as they are, dates and durations since the first of them; None for anything else."""
    if column.dtype.kind in "mM":
        return np.asarray((column - column.iloc[0]).dt.total_seconds(), dtype=np.float64)
    return numbers(column)


def numbers(column: pd.Series[Any]) -> FloatArray | None:
    """A numeric or boolean column as float64, NaN where a value is missing; None for anything else."""
    from pandas.api.types import is_numeric_dtype

    return column.to_numpy(dtype=np.float64, na_value=np.nan) if is_numeric_dtype(column.dtype) else None
