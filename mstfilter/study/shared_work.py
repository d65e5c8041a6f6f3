"""Which work the runs of a study share on disk: what is dear to compute and cheap to read.

>>> with shared_work({"folder": "cache/work", "gb": 4.0}):
...     execute(recording, config, path)

Flow through a clip, segmentation trees, completions and features depend on the recording alone, not on the arm or
the seed that asks. Entries are named by the version of the code that makes them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["kinds", "shared_work"]


@contextlib.contextmanager
def shared_work(where: Mapping[str, Any] | None) -> Iterator[None]:
    """Use the folder of shared work; none where `where` is None.

    Parameters
    ----------
    where : mapping, optional
        ``folder`` and ``gb``, the bound of its size.
    """
    from mstfilter.scene.disk_memo import DiskMemo
    from mstfilter.scene.memo import beneath

    with beneath(None if where is None else DiskMemo(Path(where["folder"]), int(where["gb"] * 1e9), kinds())):
        yield


@lru_cache(maxsize=1)
def kinds() -> dict[str, Any]:
    """The names that are kept on disk, what their entries are, and the version of their code."""
    from mstfilter.completion.completer import Completion
    from mstfilter.registry import COMPONENTS, ORACLES
    from mstfilter.scene.disk_memo import Kind
    from mstfilter.segmentation.tree import Tree
    from mstfilter.study.code_version import code_version
    from mstfilter.study.run import versions
    from mstfilter.tracking.features import Matches
    from mstfilter.tracking.flow import ClipTracks

    libraries = "".join(f"{k}={v} " for k, v in versions().items())

    def version(*slots: str, module: str) -> str:
        """Of a module and of all components that may stand in these slots."""
        named = [where for slot in slots for names in (COMPONENTS, ORACLES) for where in names.get(slot, {}).values()]
        found = [where.partition(":")[0] for where in named]
        return code_version([module, *found]) + libraries

    segmentation = version("boundary", "tree", "value", module="mstfilter.segmentation.proposal")
    return {
        "clip tracks": Kind(ClipTracks, version(module="mstfilter.tracking.flow")),
        "segmentation_tree": Kind((Tree, np.ndarray), segmentation),
        "completion": Kind(Completion, version("completer", module="mstfilter.completion.completer")),
        "sift matches": Kind(Matches, version(module="mstfilter.tracking.features")),
    }
