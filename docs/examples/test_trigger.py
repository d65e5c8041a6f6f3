"""MyTrigger keeps the contract of its interface."""

from trigger import MyTrigger

from mstfilter.testing import TriggerContract


class TestMyTrigger(TriggerContract):
    def make(self):
        return MyTrigger()
