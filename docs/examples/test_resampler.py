"""MyResampler keeps the contract of its interface."""

from resampler import MyResampler

from mstfilter.testing import WeightResamplerContract


class TestMyResampler(WeightResamplerContract):
    def make(self):
        return MyResampler()
