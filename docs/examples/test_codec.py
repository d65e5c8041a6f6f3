"""MyCodec keeps the contract of its interface."""

from codec import MyCodec, example

from mstfilter.testing import CodecContract


class TestMyCodec(CodecContract):
    def make(self):
        return MyCodec()

    def example(self, rng, n):
        return example(rng, n)
