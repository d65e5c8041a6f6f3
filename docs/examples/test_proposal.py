"""MyProposal keeps the contract of its interface."""

from proposal import MyProposal, example

from mstfilter.testing import ProposalContract


class TestMyProposal(ProposalContract):
    def make(self):
        return MyProposal()

    def example(self, rng, n):
        return example(rng, n)
