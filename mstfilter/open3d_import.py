"""The only module that imports open3d, which is large and needs system libraries.

>>> from mstfilter.open3d_import import import_open3d
>>> o3d = import_open3d()                            # doctest: +SKIP
>>> o3d.geometry.PointCloud()                        # doctest: +SKIP

Components call `import_open3d` when they need open3d. No default component needs open3d.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from mstfilter.errors import MissingLibraryError, missing_library

SYSTEM_PACKAGES = ("libusb-1.0-0", "libgl1", "libegl1", "libgomp1")


def import_open3d() -> ModuleType:
    """Import open3d, limited to one thread.

    With several threads the order of a parallel sum varies, so the last digits of results vary. Raises
    MissingLibraryError if the package or a required system library is missing.
    """
    try:
        open3d = import_module("open3d")
    except ModuleNotFoundError as error:
        raise missing_library(error, "this function") from error
    except (ImportError, OSError) as error:  # a shared library does not load
        raise MissingLibraryError(
            f"open3d cannot be imported: {error}",
            f"install its libraries: apt-get install {' '.join(SYSTEM_PACKAGES)}",
        ) from error
    open3d.utility.set_max_threads(1)
    return open3d
