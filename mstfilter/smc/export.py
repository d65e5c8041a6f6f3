"""Results as tables of pandas, and as trees of xarray for ArviZ.

>>> infos.to_pandas(), population.to_pandas(), chains.to_pandas(), history.to_pandas()
>>> arviz.summary(chains.to_arviz(["rho", "sigma"]))
>>> Population.from_arviz(population.to_arviz())              # the same particles and weights

A class with `columns` is a `Table`. The columns of a table are a mapping from names to arrays with one entry per row,
which polars accepts too. An array with several entries per row becomes several columns: ``x_0``, ``x_1``, or
``x_0_1``.

Trees are `xarray.DataTree`, the container of ArviZ 1.0 and later. ``arviz.InferenceData.from_datatree`` converts the
trees for 0.2x. The group ``posterior`` has the draws, with dimensions (chain, draw, ...). The group ``sample_stats``
has numbers that belong to draws. Weighted particles are one chain. The unnormalised log weights of the particles are
``sample_stats["log_weight"]`` (chain, draw). If the weights differ, ``posterior.attrs["weights"]`` is
"sample_stats/log_weight". ArviZ treats all draws as equally weighted. So the summaries of ArviZ are valid only for
draws without this attribute. To get equally weighted draws, resample:

>>> Systematic().resample(rng, population, 1000).to_arviz()
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np

from mstfilter.errors import MissingLibraryError


class Table(ABC):
    """A result with rows."""

    @abstractmethod
    def columns(self) -> dict[str, np.ndarray]:
        """Name -> (rows,) array."""

    def to_pandas(self) -> Any:
        """A ``pandas.DataFrame`` of the `columns`; MissingLibraryError if pandas is not installed."""
        return library("pandas").DataFrame(self.columns())


def library(name: str) -> Any:
    """Import an optional library; MissingLibraryError if it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        raise MissingLibraryError(
            f"this export needs the library {name}, which is not installed", "pip install 'mstfilter[xarray]'"
        ) from None


def flat_columns(arrays: Mapping[str, Any], axes: int = 1) -> dict[str, np.ndarray]:
    """Columns of arrays whose first `axes` axes are the rows."""
    columns = {}
    for name, a in arrays.items():
        a = np.asarray(a)
        for k in np.ndindex(a.shape[axes:]):
            columns["_".join([name, *map(str, k)])] = a[(..., *k)].reshape(-1)
    return columns


def draws_tree(posterior: Mapping[str, np.ndarray], sample_stats: Mapping[str, np.ndarray], **attributes: Any) -> Any:
    """A ``DataTree`` of arrays (chain, draw, ...), with attributes of the group posterior."""
    xarray = library("xarray")

    def dataset(arrays: Mapping[str, np.ndarray]) -> Any:
        dims = {
            name: ("chain", "draw", *(f"{name}_dim_{k}" for k in range(a.ndim - 2))) for name, a in arrays.items()
        }
        sizes = dict(zip(("chain", "draw"), next(iter(arrays.values())).shape, strict=False))
        coords = {name: np.arange(size) for name, size in sizes.items()}
        return xarray.Dataset({name: (dims[name], a) for name, a in arrays.items()}, coords)

    groups = {"posterior": dataset(posterior).assign_attrs(attributes)}
    return xarray.DataTree.from_dict(groups | ({"sample_stats": dataset(sample_stats)} if sample_stats else {}))
