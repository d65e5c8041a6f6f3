"""What writes files is stopped at some of its operations; `experiments/reliability` stops it at all of them."""

from __future__ import annotations

import numpy as np
import pytest

import mstfilter.base.files
from tests.experiments.scripts import EXPERIMENTS, own_modules

POINTS = {"run": 6, "run --replace": 6, "study": 2, "simulate": 2, "save_recording": 9, "demo": 3, "write_masks": 18}

LONG = ("run", "run --replace", "study", "simulate", "demo")


@pytest.fixture(scope="module")
def battery(recordings):
    """The modules of the experiment, and its small recording."""
    with own_modules(EXPERIMENTS / "reliability"):
        import flows

        with flows.small_recording(recordings) as recording:
            yield flows, {flow.name: flow for flow in flows.flows(recording)}


def trials(battery, name, root, points):
    """Point and loss -> result of a flow that is stopped at points spread over its operations, and at its end."""
    module, flow = battery[0], battery[1][name]
    expected, n = module.reference(flow, root / "root", root / "template")
    chosen = sorted({*np.linspace(2, n, points).astype(int).tolist(), n + 1})
    losses = [module.LOSSES[k % 3] for k in range(len(chosen) - 1)] + ["unsynced"]
    return {
        (k, loss): module.trial(flow, root / "root", k, loss, expected, root / "template")
        for k, loss in zip(chosen, losses, strict=True)
    }


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] * (name in LONG)) for name in POINTS]
)
def test_a_stopped_command_is_repeated_to_the_same_bytes(battery, tmp_path, name):
    found = trials(battery, name, tmp_path, POINTS[name])
    assert {where: result for where, result in found.items() if result != "same"} == {}


@pytest.mark.parametrize(("function", "name"), [("_sync", "save_recording"), ("sweep", "write_masks")])
def test_the_battery_notices_faults(battery, tmp_path, monkeypatch, function, name):
    """Without syncing, or without sweeping, a result is lost or litter is left."""
    monkeypatch.setattr(mstfilter.base.files, function, lambda *_, **__: None)
    found = trials(battery, name, tmp_path, POINTS[name])
    assert any(result.startswith("differs") for result in found.values())
