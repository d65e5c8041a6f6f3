"""Contracts of resamplers with fewer calls: for tests that run on every change."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mstfilter.smc.testing import ResamplerContract, WeightResamplerContract


@pytest.fixture
def fewer_calls(monkeypatch):
    """An eighth of the calls, or a quarter where there are few; the bounds allow for the number of calls.

    A fault of a few per cent may pass, so the contract with all calls runs at night.
    """
    for contract, share in ((ResamplerContract, 4), (WeightResamplerContract, 8)):
        cases = tuple(replace(case, calls=case.calls // share) for case in contract.cases)
        monkeypatch.setattr(contract, "cases", cases)
