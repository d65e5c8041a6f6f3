"""Studies on a Dask scheduler: the same results, the same isolation of what fails."""

from __future__ import annotations

import pytest

from mstfilter.errors import InputError
from mstfilter.study.local import Local
from mstfilter.study.study import run_study
from tests.study.scenes import slide
from tests.study.test_failures import figures, study, table

distributed = pytest.importorskip("distributed", reason="dask absent: pip install -e '.[dask]'")


@pytest.fixture(scope="module")
def cluster():
    options = {"processes": True, "dashboard_address": None, "host": "127.0.0.1", "silence_logs": 50}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, **options) as made:
        yield made.scheduler_address


def test_a_cluster_gives_the_same_bytes(cluster, tmp_path):
    from mstfilter.study.cluster import Cluster

    slide(tmp_path / "slide", pauses=2)
    wanted = study(tmp_path, "good", "raise", "die")
    here = run_study(wanted, tmp_path / "here", Local(1), cache=tmp_path / "cache-1")
    there = run_study(wanted, tmp_path / "there", Cluster(cluster), cache=tmp_path / "cache-2")
    assert figures(tmp_path / "there") == figures(tmp_path / "here")
    assert (tmp_path / "there" / "differences.csv").read_bytes() == (
        tmp_path / "here" / "differences.csv"
    ).read_bytes()
    assert there.done == here.done == 2
    names = [r["run"] for r in table(tmp_path / "here", "failures.csv")]
    assert [r["run"] for r in table(tmp_path / "there", "failures.csv")] == names and len(names) == 4
    died = next(outcome for name, outcome in there.failed if name.startswith("die"))
    assert "its worker died 4 times" in died.error  # Dask's own number of tries
    assert not list((tmp_path / "there" / "runs").glob(".*"))
    for one in (tmp_path / "here" / "runs").glob("good*/pauses/*/hypotheses.npz"):
        assert one.read_bytes() == (tmp_path / "there" / one.relative_to(tmp_path / "here")).read_bytes()
    again = run_study(study(tmp_path, "good"), tmp_path / "there", Cluster(cluster), cache=tmp_path / "cache-2")
    assert again.repeated == 2


def test_no_scheduler_is_one_clear_error(tmp_path):
    from mstfilter.study.cluster import Cluster

    slide(tmp_path / "slide", pauses=2)
    with pytest.raises(InputError, match="no Dask scheduler answers at tcp://127.0.0.1:9"):
        run_study(study(tmp_path, "good"), tmp_path / "out", Cluster("tcp://127.0.0.1:9", 1.0), cache=tmp_path)
