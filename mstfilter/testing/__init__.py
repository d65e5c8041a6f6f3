"""Contracts that every component keeps, ours or yours.

With pytest, five lines test your own component:

>>> from mstfilter.testing import ResamplerContract
>>> from mine import MyResampler
>>> class TestMyResampler(ResamplerContract):
...     def make(self):
...         return MyResampler()

Without pytest, ``mstfilter check ./mine.py:MyResampler`` runs the same properties and says in words which one does
not hold; `verify` does so from Python.
"""

from mstfilter.testing.contracts import (
    CodecContract,
    Contract,
    EquivalenceContract,
    EvidenceContract,
    LookaheadContract,
    ProposalContract,
    RejuvenationContract,
    ResamplerContract,
    SimilarityContract,
    SizeContract,
    TransitionContract,
    TriggerContract,
    UpdateContract,
    verify,
)
from mstfilter.testing.properties import Broken, Outcome, Property, Suite, example

__all__ = [
    "Broken",
    "CodecContract",
    "Contract",
    "EquivalenceContract",
    "EvidenceContract",
    "LookaheadContract",
    "Outcome",
    "Property",
    "ProposalContract",
    "RejuvenationContract",
    "ResamplerContract",
    "SimilarityContract",
    "SizeContract",
    "Suite",
    "TransitionContract",
    "TriggerContract",
    "UpdateContract",
    "example",
    "verify",
]
