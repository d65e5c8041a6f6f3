"""The completion network: a small 3-D U-Net with a global feature vector. The module needs torch.

>>> network = load_network("completion")
>>> p = network.probabilities([seen], edge=32)      # (1, 32, 32, 32)

From a crop of the voxel grid around an object (`mstfilter.mst.completion.crops`), it makes a logit for each voxel.
Its residual blocks work at a half, a quarter and an eighth of the resolution; at input and output, 2 x 2 x 2 voxels
are packed as channels. A vector z of global features, a linear function of the mean features at an eighth of the
resolution, scales and shifts the features at the two coarse levels (FiLM; Perez et al., "FiLM: visual reasoning with
a general conditioning layer", AAAI 2018).

`load_network` also loads a network of yours: an `Architecture` with weights in a folder, or an ONNX file.
"""

from __future__ import annotations

import functools
import hashlib
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mstfilter.base.errors import InputError, describe_error, missing_library
from mstfilter.base.reading import MAX_WEIGHTS, read_bytes
from mstfilter.base.trained import calibrated_network, layer_size, load_once, one_thread, open_model
from mstfilter.mst.completion.crops import BATCH, CHANNELS, EDGE, LARGER, PRIOR, Architecture, channels
from mstfilter.mst.completion.observed import ObservedBox, encode_box

ARCHITECTURE = "completion-unet"
_EXTRUDED = CHANNELS.index("extruded")
_LONGEST_S = 600.0  # of a call of a network in ONNX


def to_channels(x: Tensor) -> Tensor:
    """(b, c, 2x, 2y, 2z) -> (b, 8 c, x, y, z)."""
    b, c, nx, ny, nz = x.shape
    x = x.reshape(b, c, nx // 2, 2, ny // 2, 2, nz // 2, 2)
    return x.permute(0, 1, 3, 5, 7, 2, 4, 6).reshape(b, 8 * c, nx // 2, ny // 2, nz // 2)


def _to_voxels(x: Tensor) -> Tensor:
    """(b, 8, x, y, z) -> (b, 2x, 2y, 2z)."""
    b, _, nx, ny, nz = x.shape
    return x.reshape(b, 2, 2, 2, nx, ny, nz).permute(0, 4, 1, 5, 2, 6, 3).reshape(b, 2 * nx, 2 * ny, 2 * nz)


class _Block(nn.Module):
    """Residual block. The global vector z scales and shifts the features between the two convolutions."""

    def __init__(self, width: int, n_globals: int = 0) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(8, width), nn.GroupNorm(8, width)
        self.conv1, self.conv2 = nn.Conv3d(width, width, 3, padding=1), nn.Conv3d(width, width, 3, padding=1)
        self.film = nn.Linear(n_globals, 2 * width) if n_globals else None

    def forward(self, x: Tensor, z: Tensor | None = None) -> Tensor:
        y = self.norm2(self.conv1(functional.silu(self.norm1(x))))
        if self.film is not None and z is not None:
            scale, shift = self.film(z)[:, :, None, None, None].chunk(2, dim=1)
            y = y * (1 + scale) + shift
        return x + self.conv2(functional.silu(y))


class CompletionNet(nn.Module):
    """The U-Net for completion (see the module).

    Parameters
    ----------
    channels : int
        Number of input channels.
    width : int
        Number of features at half the resolution, a multiple of 8. The coarser levels have 2 and 4 times this number.
    n_globals : int
        Number of global features, the dimension of z.
    """

    def __init__(self, channels: int, width: int, n_globals: int) -> None:
        super().__init__()
        self.has_prior = channels > len(CHANNELS)
        self.stem = nn.Conv3d(8 * channels, width, 3, padding=1)
        self.fine = _Block(width)
        self.down1 = nn.Conv3d(width, 2 * width, 2, stride=2)
        self.middle = _Block(2 * width)
        self.down2 = nn.Conv3d(2 * width, 4 * width, 2, stride=2)
        self.coarse = nn.ModuleList([_Block(4 * width), _Block(4 * width)])
        self.globals = nn.Linear(4 * width, n_globals)
        self.mixed = nn.ModuleList([_Block(4 * width, n_globals), _Block(4 * width, n_globals)])
        self.up1 = nn.Conv3d(4 * width, 2 * width, 1)
        self.join1 = nn.Conv3d(4 * width, 2 * width, 1)
        self.rise = _Block(2 * width, n_globals)
        self.up2 = nn.Conv3d(2 * width, width, 1)
        self.join2 = nn.Conv3d(2 * width, width, 1)
        self.end = _Block(width)
        self.head = nn.Conv3d(width, 8, 1)
        nn.init.zeros_(self.head.weight)
        #: Logit of a voxel that is not extruded, and what extrusion adds: the network starts from this rule.
        self.rule = nn.Parameter(torch.tensor([-3.0, 4.4]))

    def forward(self, x: Tensor) -> Tensor:
        """Logits (b, X, Y, Z) of an input (b, channels, X, Y, Z). X, Y and Z are multiples of 8."""
        fine = self.fine(self.stem(to_channels(x)))
        middle = self.middle(self.down1(fine))
        y = self.down2(middle)
        for block in self.coarse:
            y = block(y)
        z = self.globals(y.mean(dim=(2, 3, 4)).float())
        for block in self.mixed:
            y = block(y, z)
        y = functional.interpolate(self.up1(y), scale_factor=2)
        y = self.rise(self.join1(torch.cat([y, middle], dim=1)), z)
        y = functional.interpolate(self.up2(y), scale_factor=2)
        y = self.end(self.join2(torch.cat([y, fine], dim=1)))
        logits = _to_voxels(self.head(functional.silu(y)).float())
        return logits + self.rule[0] + self.rule[1] * x[:, _EXTRUDED].float()


class TrainedNetwork:
    """A completion network with loaded weights.

    Parameters
    ----------
    forward : callable
        Function from the input (b, channels, X, Y, Z) to logits (b, X, Y, Z).
    key : str
        Key of the contents of the weights.
    scale, shift : float
        Calibration of the logits.
    has_prior : bool
        Whether the input has the channel `PRIOR`.
    """

    def __init__(
        self,
        forward: Callable[[Tensor], Tensor],
        key: str,
        scale: float = 1,
        shift: float = 0,
        has_prior: bool = False,
    ) -> None:
        self.forward, self.key, self.scale, self.shift = forward, key, scale, shift
        self.has_prior = has_prior

    def probabilities(
        self, seen: Sequence[ObservedBox], edge: int, priors: Sequence[np.ndarray] | None = None
    ) -> np.ndarray:
        """Calibrated probabilities (n, edge, edge, edge) float32 of at most `BATCH` boxes.

        A network with the channel `PRIOR` needs its values for each box, an array of the shape of the box.
        """
        bits = np.zeros((BATCH, edge, edge, edge), np.uint8)
        signed = np.zeros(bits.shape, np.int8)
        prior = None if priors is None else np.zeros(bits.shape, np.float32)
        height = np.zeros(edge)
        for k, one in enumerate(seen):
            a, b, c = one.surface.shape
            bits[k, :a, :b, :c], signed[k, :a, :b, :c] = encode_box(one)
            height = one.height[0] + one.voxel_size * np.arange(edge)
            if prior is not None and priors is not None:
                prior[k, :a, :b, :c] = priors[k]
        with torch.inference_mode(), one_thread():
            x = channels(
                torch.from_numpy(bits),
                torch.from_numpy(signed),
                torch.from_numpy(height).float(),
                None if prior is None else torch.from_numpy(prior),
            )
            p = torch.sigmoid(self.scale * self.forward(x) + self.shift)
        return np.asarray(p.numpy()[: len(seen)])


@load_once
def load_network(name: str, architecture: Architecture | None = None) -> TrainedNetwork:
    """Load a network by the name or folder of its model (`mstfilter.base.trained.open_model`), or from an ONNX file.

    A network of yours is tried on each crop size. Raises InputError if it fails or returns invalid output.
    """
    if architecture is None and not name.endswith(".onnx"):
        model = open_model(name, ARCHITECTURE)
        has_prior = PRIOR in model.description.get("network", {}).get("channels", ())
        names = (*CHANNELS, PRIOR) if has_prior else CHANNELS
        net, scale, shift = calibrated_network(
            model,
            names,
            lambda values: CompletionNet(len(names), layer_size(values, "width"), layer_size(values, "n_globals", 0)),
        )
        return TrainedNetwork(net, model.key, scale, shift, has_prior)
    if name.endswith(".onnx"):
        if architecture is not None:
            raise InputError(f"{name} contains its architecture", "leave the field architecture out")
        opened = _open_onnx(Path(name))
    else:
        assert architecture is not None
        model = open_model(name, type(architecture).__name__)
        built = architecture.build()
        if not isinstance(built, nn.Module):
            raise InputError(
                f"build of {type(architecture).__name__} returns {type(built).__name__}, no torch.nn.Module"
            )
        net, scale, shift = calibrated_network(model, CHANNELS, lambda values: built)
        opened = TrainedNetwork(net, model.key, scale, shift)
    opened.forward = functools.partial(_checked, name, opened.forward)
    with torch.inference_mode():
        for edge in (EDGE, *LARGER):
            opened.forward(torch.zeros(1, len(CHANNELS), edge, edge, edge))
    return opened


def _checked(name: str, forward: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """The logits (b, X, Y, Z) of a user's network. Raises InputError if the network fails or a logit is invalid."""
    try:
        out = forward(x)
    except Exception as error:  # of the user's code or of the runtime: any
        cause = describe_error(error).splitlines()[0]
        raise InputError(f"{name}: the network fails on an input of shape {tuple(x.shape)}: {cause}") from error
    shape = (len(x), *x.shape[2:])
    found = tuple(out.shape) if isinstance(out, Tensor) else type(out).__name__
    if not isinstance(out, Tensor) or found not in (shape, (len(x), 1, *shape[1:])):
        raise InputError(
            f"{name}: the output of the network is {found}, expected {shape}", "one logit for each voxel of the input"
        )
    if not out.isfinite().all():
        raise InputError(f"{name}: the output of the network is not finite")
    return out.reshape(shape).float()


def _open_onnx(path: Path) -> TrainedNetwork:
    try:
        import onnxruntime
    except ImportError as error:
        raise missing_library(error, "a network in ONNX", library="onnxruntime") from error
    if not path.is_file():
        raise InputError(f"file of a network does not exist: {path}")
    data = read_bytes(path, "a network", limit=MAX_WEIGHTS)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # results must not depend on the number of cores
    options.log_severity_level = 4
    try:  # from bytes, so that no other file is read
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors have no common base
        raise InputError(
            f"{path} is no network that onnxruntime {onnxruntime.__version__} can run: {str(error).splitlines()[0]}",
            "export it again with the weights in the same file: external_data=False",
        ) from error
    inputs = session.get_inputs()
    x = inputs[0].shape if inputs else []
    fixed = [n for k, n in enumerate(x) if k != 1 and isinstance(n, int)]
    if len(x) != 5 or x[1] != len(CHANNELS) or fixed or len(inputs) != 1:
        raise InputError(
            f"{path}: the inputs of the network are {[one.shape for one in inputs]}, expected "
            f"[[n, {len(CHANNELS)}, x, y, z]]",
            "export it with one input whose axes are all dynamic but the second",
        )

    def forward(x: Tensor) -> Tensor:
        run = onnxruntime.RunOptions()
        run.log_severity_level = 4
        timer = threading.Timer(_LONGEST_S, setattr, (run, "terminate", True))
        timer.daemon = True
        timer.start()
        try:
            return torch.from_numpy(session.run(None, {inputs[0].name: x.numpy()}, run)[0])
        except Exception as error:
            if run.terminate:
                raise InputError(f"it has not ended after {_LONGEST_S:g} s, as in an endless loop") from error
            raise
        finally:
            timer.cancel()

    return TrainedNetwork(forward, hashlib.sha256(data).hexdigest()[:16])
