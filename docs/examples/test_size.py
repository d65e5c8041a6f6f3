"""MySize keeps the contract of its interface."""

from size import MySize

from mstfilter.testing import SizeContract


class TestMySize(SizeContract):
    def make(self):
        return MySize()
