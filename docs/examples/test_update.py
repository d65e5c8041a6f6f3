"""MyUpdate keeps the contract of its interface."""

from update import MyUpdate, exact, example

from mstfilter.testing import UpdateContract


class TestMyUpdate(UpdateContract):
    def make(self):
        return MyUpdate()

    def example(self, rng, n):
        return example(rng, n)

    def exact(self, rng, n):
        return exact(rng, n)
