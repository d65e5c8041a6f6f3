"""MyRejuvenation keeps the contract of its interface."""

from rejuvenation import MyRejuvenation, exact, example

from mstfilter.testing import RejuvenationContract


class TestMyRejuvenation(RejuvenationContract):
    def make(self):
        return MyRejuvenation()

    def example(self, rng, n):
        return example(rng, n)

    def exact(self, rng, n):
        return exact(rng, n)
