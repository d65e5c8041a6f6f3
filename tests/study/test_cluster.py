"""Studies on a Dask scheduler: the same results, the same isolation of what fails."""

from __future__ import annotations

import contextlib

import pytest

from mstfilter.errors import InputError
from mstfilter.study.cluster import Cluster
from mstfilter.study.executors import Local
from mstfilter.study.plan import make_plan
from mstfilter.study.study import run_study
from tests.study.scenes import metrics, slide, table
from tests.study.test_failures import LimitHanging, study

dask = pytest.importorskip("dask", reason="dask absent: pip install -e '.[dask]'")
distributed = pytest.importorskip("distributed", reason="dask absent: pip install -e '.[dask]'")


START_S = 300.0  # a worker that died may still be starting again; this takes long on a busy machine


@contextlib.contextmanager
def local_cluster(n_workers, *, allowed_failures=1):
    """A Dask cluster in processes of this machine.

    Dask closes the nanny of a worker that is not back after ``lost-worker-timeout``. Its default of 15 s is exceeded
    on a busy machine, and the cluster then loses its workers one by one.
    """
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"}),
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
    slide(tmp_path / "slide", pauses=2)
    wanted = study(tmp_path, "mst", "good", "raise", "die", seeds=[0], tries=1)
    here = run_study(wanted, tmp_path / "here", Local(1), cache=tmp_path / "cache-1")
    seen = []
    there = run_study(
        wanted, tmp_path / "there", Cluster(cluster, START_S), cache=tmp_path / "cache-2", progress=seen.append
    )
    assert sorted(p.name for p in seen if p.outcome) == sorted(run.name for run in make_plan(wanted).runs)
    assert metrics(tmp_path / "there") == metrics(tmp_path / "here")
    assert (tmp_path / "there" / "differences.csv").read_bytes() == (
        tmp_path / "here" / "differences.csv"
    ).read_bytes()
    assert there.done == here.done == 2
    names = [r["run"] for r in table(tmp_path / "here", "failures.csv")]
    assert [r["run"] for r in table(tmp_path / "there", "failures.csv")] == names and len(names) == 2
    died = next(outcome for name, outcome in there.failed if name.startswith("die"))
    assert died.error == "its worker died, 2 times"  # allowed_failures of the scheduler, not tries
    assert not list((tmp_path / "there" / "runs").glob(".*"))
    for one in (tmp_path / "here" / "runs").glob("mst*/pauses/*/state.npz"):
        assert one.read_bytes() == (tmp_path / "there" / one.relative_to(tmp_path / "here")).read_bytes()
    again = run_study(
        study(tmp_path, "mst", seeds=[0]), tmp_path / "there", Cluster(cluster, START_S), cache=tmp_path / "cache-2"
    )
    assert again.repeated == 1


def test_a_run_that_takes_too_long_is_named(tmp_path):
    """Its worker is there for others afterwards."""
    slide(tmp_path / "slide", pauses=2)
    with local_cluster(1, allowed_failures=0) as address:
        executor = LimitHanging(Cluster(address, START_S), timeout_s=1)
        wanted = study(tmp_path, "good", "hang", seeds=[0])
        result = run_study(wanted, tmp_path / "out", executor, cache=tmp_path)
        assert [(n, o.error, o.tries) for n, o in result.failed] == [
            ("hang on slide, seed 0", "its worker died or it took longer than 1 s, 1 time", 1)
        ]
        assert result.done == 1
        again = run_study(study(tmp_path, "good", seeds=[0, 1, 2]), tmp_path / "out", executor, cache=tmp_path)
        assert (again.done, again.repeated) == (3, 1)


def test_no_scheduler_is_one_clear_error(tmp_path):
    slide(tmp_path / "slide", pauses=2)
    with pytest.raises(InputError, match="no Dask scheduler answers at tcp://127.0.0.1:9"):
        run_study(
            study(tmp_path, "good"), tmp_path / "out", Cluster("tcp://127.0.0.1:9", connect_s=1.0), cache=tmp_path
        )
