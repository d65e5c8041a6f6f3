"""Which work the runs of a study share on disk: what is dear to compute and cheap to read.

>>> with shared_work({"folder": "cache/work", "gb": 4.0, "versions": kind_versions()}):
...     filter_recording(recording, config, path)

Flow through a clip, segmentation trees, completions and features depend on the recording alone, not on the arm or
the seed that asks. Entries are named by the version of the code that makes them.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.presets import REGISTRY
from mstfilter.runs.run import versions
from mstfilter.study.code_version import code_version

__all__ = ["kind_versions", "shared_work"]


@contextlib.contextmanager
def shared_work(where: Mapping[str, Any] | None) -> Iterator[None]:
    """Use the folder of shared work; none where `where` is None.

    Parameters
    ----------
    where : mapping, optional
        ``folder``, ``gb``, the bound of its size, and ``versions`` as `kind_versions` gives them.
    """
    from mstfilter.scene import beneath

    if where is None:
        with beneath(None):
            yield
        return
    with beneath(_layer(Path(where["folder"]), int(where["gb"] * 1e9), tuple(where["versions"].items()))):
        yield


@functools.lru_cache(maxsize=1)
def _layer(folder: Path, limit_bytes: int, versions: tuple[tuple[str, str], ...]) -> Any:
    """One for all runs of a worker, so that what they write together is what it counts."""
    from mstfilter.completion import Completion
    from mstfilter.scene import DiskMemo, Kind
    from mstfilter.segmentation import Tree
    from mstfilter.tracking import ClipTracks, Matches

    types = {
        "clip tracks": ClipTracks,
        "segmentation_tree": (Tree, np.ndarray),
        "completion": Completion,
        "sift matches": Matches,
    }
    return DiskMemo(folder, limit_bytes, {name: Kind(types[name], version) for name, version in versions})


def kind_versions() -> dict[str, str]:
    """The names that are kept on disk, and the version of the code and the libraries that make their entries."""
    libraries = "".join(f"{k}={v} " for k, v in versions().items())

    def version(*slots: str, module: str) -> str:
        """Of a module and of all components that may stand in these slots."""
        named = [where for slot in slots for where in REGISTRY.known(slot).values()]
        return code_version([module, *(where.partition(":")[0] for where in named)]) + libraries

    return {
        "clip tracks": version(module="mstfilter.tracking.flow"),
        "segmentation_tree": version("boundary", "tree", "value", module="mstfilter.segmentation.proposal"),
        "completion": version("completer", module="mstfilter.completion.completer"),
        "sift matches": version(module="mstfilter.tracking.features"),
    }
