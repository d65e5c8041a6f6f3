"""Tests of the contracts."""

from __future__ import annotations

from mstfilter.smc.testing.contract import restore_global_state
from mstfilter.testing import contract_of


def run_property(component, name, exact=None):
    """Run one test of the contract of a component, without the others."""
    methods = {"make": staticmethod(lambda: component)}
    if exact is not None:
        methods["exact"] = staticmethod(exact)
    contract = type("Contract", (contract_of(type(component)),), methods)()
    contract.setup_method()
    try:
        getattr(contract, f"test_{name}")()
    finally:
        restore_global_state(contract._global_state)
