"""A completion network in torch, and its weights in a folder that `update.completer=network` opens.

python architecture.py
mstfilter run demo/recording update.completer=network update.completer.weights=trained/mine \
update.completer.architecture=./architecture.py:MyArchitecture --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from mstfilter.base.trained import write_model
from mstfilter.mst.completion import CHANNELS, Architecture


@dataclass(frozen=True)
class MyArchitecture(Architecture):
    """Corrects the result of extrusion by two convolutions.

    Parameters
    ----------
    width : int
        Features between the convolutions.
    """

    width: int = 8

    def build(self) -> nn.Module:
        """From crops (b, 8, X, Y, Z) to logits (b, X, Y, Z)."""
        return Corrected(self.width)


class Corrected(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.inner = nn.Conv3d(len(CHANNELS), width, 3, padding=1)
        self.outer = nn.Conv3d(width, 1, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        extruded = x[:, -1]  # 0 or 1
        return 4 * extruded - 2 + self.outer(torch.relu(self.inner(x)))[:, 0]


if __name__ == "__main__":
    torch.manual_seed(0)
    net = MyArchitecture().build()
    # Train it here. `mstfilter train completion` makes samples: see models/mst_training.
    description = {
        "architecture": "MyArchitecture",
        "network": {"channels": CHANNELS},
        "calibration": {"scale": 1.0, "shift": 0.0},  # of the logits
    }
    write_model("trained/mine", description, {name: t.numpy() for name, t in net.state_dict().items()})
    print("trained/mine")
