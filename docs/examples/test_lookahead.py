"""MyLookahead keeps the contract of its interface."""

from lookahead import MyLookahead, example

from mstfilter.testing import LookaheadContract


class TestMyLookahead(LookaheadContract):
    def make(self):
        return MyLookahead()

    def example(self, rng, n):
        return example(rng, n)
