"""MyTransition keeps the contract of its interface."""

from transition import MyTransition, exact, example

from mstfilter.testing import TransitionContract


class TestMyTransition(TransitionContract):
    def make(self):
        return MyTransition()

    def example(self, rng, n):
        return example(rng, n)

    def exact(self, rng, n):
        return exact(rng, n)
