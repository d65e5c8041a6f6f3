"""Tests of the contracts, and what makes faulty components of functions."""

from __future__ import annotations

from dataclasses import dataclass
from unittest import SkipTest

from mstfilter.mst.testing import contract_of


def run_property(component, name, exact=None):
    """Run one test of the contract of a component, without the others. A test that is skipped is an error."""
    methods = {"make": staticmethod(lambda: component)}
    if exact is not None:
        methods["exact"] = staticmethod(exact)
    contract = type("Contract", (contract_of(type(component)),), methods)()
    try:
        getattr(contract, f"test_{name}")()
    except SkipTest as reason:
        raise RuntimeError(f"the property is not tested: {reason}") from None


class Faults(list):
    """Faulty classes: (class, a property that it breaks, words of the message, exact draws or None)."""

    def faulty(self, broken, words, exact=None):
        """Add a class."""

        def add(cls):
            self.append((cls, broken, words, exact))
            return cls

        return add

    def plant(self, make, *common, **faults):
        """Add the classes that `make` gives of functions: ``name=(broken property, words, function, exact draws)``.

        `common` are values that all faults begin with.
        """
        for name, values in faults.items():
            broken, words, function, *exact = (*common, *(values if isinstance(values, tuple) else (values,)))
            function.__name__ = name
            self.faulty(broken, words, *exact)(make(function))


def of(interface, fields=None, **methods):
    """A function that makes a class of an interface: ``method=function(its argument, *arguments)``."""

    def make(function):
        def bound(method):
            return lambda self, *args, **named: method(function, *args, **named)

        called = {name: bound(method) for name, method in methods.items()}
        stated = {"__module__": function.__module__, "__doc__": function.__doc__, **(fields or {})}
        return dataclass(frozen=True)(type(function.__name__, (interface,), called | stated))

    return make


def plainly(function, *args, **named):
    """The method that is the function."""
    return function(*args, **named)
