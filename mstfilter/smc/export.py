"""Results as tables.

>>> infos.to_pandas(), population.to_pandas(), chains.to_pandas(), history.to_pandas()

A class with `columns` is a `Table`: its columns are a mapping from names to arrays with one entry per row, which
polars takes as well. An array with several entries per row has a column for each: ``x_0``, ``x_1``, or ``x_0_1``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np

from mstfilter.errors import missing_library


class Table(ABC):
    """A result with rows."""

    @abstractmethod
    def columns(self) -> dict[str, np.ndarray]:
        """Name -> (rows,) array."""

    def to_pandas(self) -> Any:
        """A ``pandas.DataFrame`` of the `columns`; MissingLibraryError if pandas is not installed."""
        return library("pandas").DataFrame(self.columns())


def library(name: str) -> Any:
    """An optional library; MissingLibraryError if it is not installed."""
    try:
        return import_module(name)
    except ImportError as error:
        raise missing_library(error, "this export", library=name) from error


def flat_columns(arrays: Mapping[str, Any], axes: int = 1) -> dict[str, np.ndarray]:
    """Columns of arrays whose first `axes` axes are the rows."""
    columns = {}
    for name, a in arrays.items():
        a = np.asarray(a)
        for k in np.ndindex(a.shape[axes:]):
            columns["_".join([name, *map(str, k)])] = a[(..., *k)].reshape(-1)
    return columns
