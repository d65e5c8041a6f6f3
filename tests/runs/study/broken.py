"""A component that fails in the ways that runs and studies must survive; loaded by file."""

from __future__ import annotations

import errno
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from mstfilter.smc import Transition


@dataclass(frozen=True)
class Breaks(Transition):
    """Fails at a pause in the way `how`; with a marker file, which it makes, it fails only once."""

    how: str = "raise"
    at: int = 1
    marker: str = ""

    def predict(self, rng, population, observation):
        if observation.index == self.at and not (self.marker and Path(self.marker).exists()):
            if self.marker:
                Path(self.marker).touch()
            if self.how == "raise":
                raise RuntimeError("the component broke")
            if self.how == "die":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.how == "exit":
                os._exit(7)
            if self.how == "full":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "state.npz")
            if self.how == "hang":
                while True:
                    time.sleep(60)
            if self.how == "print":
                print('{"outcome": {"status": "done"}}', flush=True)
                os.write(1, b"noise of a library\n")
        return population
