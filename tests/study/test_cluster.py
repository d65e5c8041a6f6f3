"""Studies on a Dask scheduler: the same results, the same isolation of what fails."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import pytest

from mstfilter.errors import InputError
from mstfilter.study.executors import Local
from mstfilter.study.study import run_study
from tests.study.scenes import slide
from tests.study.test_failures import LimitHanging, metrics, study, table

dask = pytest.importorskip("dask", reason="dask absent: pip install -e '.[dask]'")
distributed = pytest.importorskip("distributed", reason="dask absent: pip install -e '.[dask]'")


START_S = 300.0  # a worker that died may still be starting again; this takes long on a busy machine


@contextlib.contextmanager
def local_cluster(n_workers, *, allowed_failures=1, lost_worker_timeout="1h"):
    """A Dask cluster in processes of this machine.

    Dask closes the nanny of a worker that is not back after `lost_worker_timeout`. Its default of 15 s is exceeded on
    a busy machine, and the cluster then loses its workers one by one.
    """
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": lost_worker_timeout}),
        distributed.LocalCluster(
            n_workers=n_workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",
            host="127.0.0.1",
            silence_logs=50,
            scheduler_kwargs={"allowed_failures": allowed_failures},
        ) as made,
    ):
        yield made.scheduler_address


@pytest.fixture(scope="module")
def cluster():
    with local_cluster(2) as address:
        yield address


def test_a_cluster_gives_the_same_bytes(cluster, tmp_path):
    from mstfilter.study.cluster import Cluster

    slide(tmp_path / "slide", pauses=2)
    wanted = study(tmp_path, "mst", "good", "raise", "die", seeds=[0], tries=1)
    here = run_study(wanted, tmp_path / "here", Local(1), cache=tmp_path / "cache-1")
    seen = []
    there = run_study(
        wanted,
        tmp_path / "there",
        Cluster(cluster, START_S),
        cache=tmp_path / "cache-2",
        progress=lambda p: seen.append(p.event),
    )
    events = [(e.kind, e.job) for e in seen if e is not None]
    for job in range(4):  # each job starts once and before it ends
        assert events.count(("started", job)) == events.count(("ended", job)) == 1
        assert events.index(("started", job)) < events.index(("ended", job))
    assert metrics(tmp_path / "there") == metrics(tmp_path / "here")
    assert (tmp_path / "there" / "differences.csv").read_bytes() == (
        tmp_path / "here" / "differences.csv"
    ).read_bytes()
    assert there.done == here.done == 2
    names = [r["run"] for r in table(tmp_path / "here", "failures.csv")]
    assert [r["run"] for r in table(tmp_path / "there", "failures.csv")] == names and len(names) == 2
    died = next(outcome for name, outcome in there.failed if name.startswith("die"))
    assert "its worker died 2 times" in died.error  # allowed_failures of the scheduler, not tries
    assert not list((tmp_path / "there" / "runs").glob(".*"))
    for one in (tmp_path / "here" / "runs").glob("mst*/pauses/*/state.npz"):
        assert one.read_bytes() == (tmp_path / "there" / one.relative_to(tmp_path / "here")).read_bytes()
    again = run_study(
        study(tmp_path, "mst", seeds=[0]), tmp_path / "there", Cluster(cluster, START_S), cache=tmp_path / "cache-2"
    )
    assert again.repeated == 1


def test_a_run_that_takes_too_long_is_named(cluster, tmp_path):
    """Its worker is there for others afterwards."""
    from mstfilter.study.cluster import Cluster

    slide(tmp_path / "slide", pauses=2)
    executor = LimitHanging(Cluster(cluster, START_S), timeout_s=1)
    wanted = study(tmp_path, "hang", "good", seeds=[0], tries=1)
    result = run_study(wanted, tmp_path / "out", executor, cache=tmp_path)
    assert [(n, o.error, o.tries) for n, o in result.failed] == [
        ("hang on slide, seed 0", "it took longer than 1 s, 1 time", 1)
    ]
    assert result.done == 1
    again = run_study(study(tmp_path, "good", seeds=[0, 1, 2]), tmp_path / "out", executor, cache=tmp_path)
    assert (again.done, again.repeated) == (3, 1)


def test_a_dying_worker_fails_only_the_job_that_it_ran(tmp_path):
    """The other jobs of the worker waited; they are submitted again."""
    from mstfilter.study.cluster import Cluster

    slide(tmp_path / "slide", pauses=2)
    with local_cluster(1, allowed_failures=0) as address:
        result = run_study(
            study(tmp_path, "die", "good", seeds=[0]), tmp_path / "out", Cluster(address, START_S), cache=tmp_path
        )
    assert [(n, o.error) for n, o in result.failed] == [("die on slide, seed 0", "its worker died 1 time")]
    assert result.done == 1


def test_a_cluster_without_workers_ends_the_study(tmp_path):
    """The worker dies and is not restarted; the runs that are done remain."""
    from mstfilter.study.cluster import Cluster

    slide(tmp_path / "slide", pauses=2)
    wanted = study(tmp_path, "good", "die", seeds=[0])
    with local_cluster(1, lost_worker_timeout="0s") as address:
        executor = Cluster(address, START_S, without_workers_s=0.1)
        with pytest.raises(InputError, match=r"has had no workers for 0\.1 s; 1 of 2 jobs have ended"):
            run_study(wanted, tmp_path / "out", executor, cache=tmp_path)
        with pytest.raises(InputError, match="has no workers"):
            run_study(wanted, tmp_path / "out", replace(executor, connect_s=3.0), cache=tmp_path)
    assert len(list((tmp_path / "out" / "runs").glob("good*/result.json"))) == 1


def test_no_scheduler_is_one_clear_error(tmp_path):
    from mstfilter.study.cluster import Cluster

    slide(tmp_path / "slide", pauses=2)
    with pytest.raises(InputError, match="no Dask scheduler answers at tcp://127.0.0.1:9"):
        run_study(
            study(tmp_path, "good"), tmp_path / "out", Cluster("tcp://127.0.0.1:9", connect_s=1.0), cache=tmp_path
        )
