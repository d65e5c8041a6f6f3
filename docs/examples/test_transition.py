"""MyTransition keeps the contract of its interface."""

from transition import MyTransition, example

from mstfilter.testing import TransitionContract


class TestMyTransition(TransitionContract):
    def make(self):
        return MyTransition()

    def example(self, rng, n):
        return example(rng, n)
