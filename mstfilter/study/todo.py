"""What of a plan is left to do, as jobs that a worker can do knowing nothing else.

>>> todo = ToDo(plan, folder, allow_files=True, cache=Path("cache"))
>>> todo.check_space()
>>> waiting, done = todo.runs()
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from mstfilter.runs.run import versions
from mstfilter.study.code_version import code_version, files_version, package_version, reached
from mstfilter.study.executors import Job
from mstfilter.study.plan import Plan, StudyRun
from mstfilter.study.results import StudyFolder, read_result
from mstfilter.study.space import check_space, recording_bytes, run_bytes

__all__ = ["ToDo"]

_WORK_A_SCENE = 5e7  # bytes that are shared on disk, about


@dataclass(frozen=True)
class ToDo:
    """The jobs of a plan.

    Parameters
    ----------
    plan : Plan
    folder : StudyFolder
    allow_files : bool
        Whether components may come from ``./file.py:Class``.
    cache : Path
        Holds ``recordings`` and ``work``.
    """

    plan: Plan
    folder: StudyFolder
    allow_files: bool
    cache: Path

    @property
    def recordings(self) -> str:
        """Where simulated recordings are kept."""
        return str((self.cache / "recordings").absolute())

    @cached_property
    def _code(self) -> dict[str, Any]:
        """The code of all arms. A worker makes sure of it once, so that later changes of files meet no part of it."""
        modules = sorted(reached(module for arm in self.plan.arms for module in arm.modules))
        return {"modules": modules, "code": files_version(modules)}

    def runs(self) -> tuple[list[tuple[StudyRun, Job]], set[str]]:
        """Runs to do with their jobs, and the folders of those that are done."""
        self._adopt()
        metrics = code_version(["mstfilter.runs.metrics"])
        waiting, done = [], set()
        for run in self.plan.runs:
            kind = self._needed(run, metrics)
            if kind is None:
                done.add(run.folder)
            else:
                waiting.append((run, self._job(run, kind, metrics)))
        return waiting, done

    def _adopt(self) -> None:
        """Give runs that are done under another name, that of a renamed arm or scene, the name they have now."""
        folders = {run.identity: self.folder.run(run.folder) for run in self.plan.runs}
        for path in (self.folder.path / "runs").glob("*"):
            if path in folders.values():
                continue
            found = read_result(path)
            wanted = folders.get(found.get("identity", ""))
            if wanted is not None and found.get("status") == "done" and not wanted.exists():
                path.rename(wanted)

    def _needed(self, run: StudyRun, metrics: str) -> str | None:
        """What is left to do of a run; None if nothing is. One that failed while it was measured again is whole."""
        path = self.folder.run(run.folder)
        found = read_result(path)
        if found.get("identity") != run.identity or "costs" not in found:
            return "run"
        if found.get("status") == "done" and found.get("metrics") == metrics:
            return None
        return "measure" if (path / "pauses").is_dir() else "run"

    def _job(self, run: StudyRun, kind: str, metrics: str) -> Job:
        return {
            "kind": kind,
            "name": run.name,
            "share": run.scene.key,
            "folder": str(self.folder.run(run.folder).absolute()),
            "identity": run.identity,
            "metrics": metrics,
            **self._code,
            "config": {**run.arm.config, "description": run.arm.name},
            "source": run.scene.source,
            "seed": run.seed,
            "keep": self.plan.config.keep,
            "allow_files": self.allow_files,
            "recordings": self.recordings,
            "work": self._work(run),
        }

    def _work(self, run: StudyRun) -> dict[str, Any] | None:
        """The folder of shared work; none for an arm with installed components of others, whose version we do not
        know."""
        gb = self.plan.config.cache_gb
        if not gb or not run.arm.ours:
            return None
        return {
            "folder": str((self.cache / "work").absolute()),
            "limit_bytes": int(gb * 1e9),
            "version": self._version,
        }

    @cached_property
    def _version(self) -> str:
        """The code of the package and its libraries: what computes shared work."""
        return "".join([package_version(), *(f" {name}={version}" for name, version in versions().items())])

    def check_space(self) -> None:
        """Raise InputError if what is left to do will not fit on the disk."""
        waiting = [run for run, job in self.runs()[0] if job["kind"] == "run"]
        keep = self.plan.config.keep
        sizes = Counter((run.scene.key, int(run.arm.config["n"])) for run in waiting)
        sources = {run.scene.key: run.scene.source for run in waiting}
        runs = sum(many * run_bytes(sources[key], n, keep) for (key, n), many in sizes.items())
        records = sum(recording_bytes(job["source"]) for job in self.records()[1])
        work = min(self.plan.config.cache_gb * 1e9, _WORK_A_SCENE * len(sources))
        check_space(
            {"the study": (self.folder.path, runs), "the cache of recordings and work": (self.cache, records + work)}
        )

    def records(self) -> tuple[list[str], list[Job]]:
        """Keys and jobs of simulated recordings that are needed and missing."""
        waiting, _ = self.runs()
        scenes = {run.scene.key: run.scene for run, _ in waiting if "family" in run.scene.source}
        missing = [s for s in scenes.values() if not _is_made(s.source, self.recordings)]
        jobs: list[Job] = [
            {"kind": "record", "name": s.name, "share": s.key, "source": s.source, "recordings": self.recordings}
            for s in missing
        ]
        return [s.key for s in missing], jobs


def _is_made(source: dict[str, Any], recordings: str) -> bool:
    from dataclasses import replace

    from mstfilter.simulation import recipe_key, scene_family

    family = replace(scene_family(source["family"]), **source["set"])
    return (
        Path(recordings) / f"{family.name}-{source['seed']}-{recipe_key(family, source['seed'])}" / "manifest.json"
    ).is_file()
