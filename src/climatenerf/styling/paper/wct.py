"""Whitening and colouring of features (WCT; Li et al. 2017, "Universal Style Transfer").

Encoder k maps a picture to the features after ReLU k_1 of a VGG network, decoder k maps them back.
Between the two, the features of each class get mean and covariance of the class in the style
photos. The weights are the user's: files `encoder1.pth`, `decoder1.pth` and so on in one folder.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.device import CPU, to_device, to_numpy
from climatenerf.core.errors import UserError, one_line
from climatenerf.core.regular_files import check_regular

LAYERS = ("conv11", "conv12", "conv21", "conv22", "conv31")
LEVELS = (3, 2, 1)
"""Levels of one transfer, in their order. Level 4 turns trees into blobs."""
ALPHA = 0.6
"""Fraction of the transferred features; the rest are those of the picture."""
FLOOR = 1e-4
"""Least eigenvalue of a covariance; a feature that is constant in the picture would become noise"""
MIN_PIXELS = 500  # of a class, in the picture and in the style photos

Layer = tuple[Float[Tensor, "o i k k"], Float[Tensor, "o"]]
Masks = Mapping[int, Bool[np.ndarray, "h w"]]


@dataclass(frozen=True)
class Autoencoder:
    """The networks of one level.

    Attributes:
        level: k.
        normalisation: 1x1 convolution of the display picture.
        encoder: 3x3 convolutions from `conv11` to `convk1`.
        decoder: the same places in reverse order.
    """

    level: int
    normalisation: Layer
    encoder: tuple[Layer, ...]
    decoder: tuple[Layer, ...]


@dataclass(frozen=True)
class Moments:
    """Sums over the features of a class.

    Attributes:
        count: number of features.
        total: sum of features.
        square: sum of their outer products.
    """

    count: int
    total: Float[Tensor, "c"]
    square: Float[Tensor, "c c"]

    def __add__(self, other: "Moments") -> "Moments":
        """Return the sums over both."""
        count = self.count + other.count
        return Moments(count, self.total + other.total, self.square + other.square)

    @property
    def mean(self) -> Float[Tensor, "c"]:
        """Mean feature."""
        return self.total / self.count

    @property
    def covariance(self) -> Float[Tensor, "c c"]:
        """Covariance of the features."""
        return self.square / self.count - self.mean[:, None] * self.mean


def load_autoencoders(folder: Path) -> tuple[Autoencoder, ...]:
    """Read the networks of all `LEVELS` from a folder.

    Raises:
        UserError: a file is absent or damaged, or has another layout.
    """
    if not folder.is_dir():
        raise UserError(
            f"there is no folder {folder}; give with --wct the folder of encoder1.pth, decoder1.pth"
            " and so on"
        )
    return tuple(_autoencoder(folder, level) for level in LEVELS)


def _autoencoder(folder: Path, level: int) -> Autoencoder:
    """Read one level; the widths of its layers are those of the files."""
    names = LAYERS[: LAYERS.index(f"conv{level}1") + 1]
    files = [folder / f"{kind}{level}.pth" for kind in ("encoder", "decoder")]
    found = [_read(path) for path in files]
    first = _layer(found[0], "conv0", files[0], (3, 3, 1))
    encoder, width = [], 3
    for name in names:
        encoder.append(_layer(found[0], name, files[0], (None, width, 3)))
        width = encoder[-1][1].shape[0]
    decoder = []
    for name in reversed(names):
        wanted = 3 if name == "conv11" else None
        decoder.append(_layer(found[1], name, files[1], (wanted, width, 3)))
        width = decoder[-1][1].shape[0]
    return Autoencoder(level, first, tuple(encoder), tuple(decoder))


def _read(path: Path) -> Mapping[str, Tensor]:
    """Read the tensors of a file, without running code in it."""
    check_regular(path, "the weights")
    if not path.is_file():
        raise UserError(f"{path.parent} holds no {path.name}; give the folder of the WCT weights")
    try:
        data = torch.load(path, map_location=CPU, weights_only=True)
    except Exception as error:  # noqa: BLE001, torch raises many kinds for damaged files
        raise UserError(
            f"the weights {path} cannot be read ({one_line(str(error), 80)}); copy them again"
        ) from error
    tensors = data.get("model", data) if isinstance(data, dict) else None
    if not isinstance(tensors, dict):
        raise UserError(f"the weights {path} hold no tensors by name; give those of WCT")
    return tensors


def _layer(
    tensors: Mapping[str, object], name: str, path: Path, shape: tuple[int | None, int, int]
) -> Layer:
    """Return a convolution of a file: outputs (None: any), inputs and side of its kernel."""
    weight, bias = tensors.get(f"{name}.weight"), tensors.get(f"{name}.bias")
    outputs, inputs, side = shape
    if isinstance(weight, Tensor) and isinstance(bias, Tensor):
        wide = bias.numel() if outputs is None else outputs
        if bias.shape == (wide,) and weight.shape == (wide, inputs, side, side):
            return _finite(weight.float(), path), _finite(bias.float(), path)
    raise UserError(
        f"the weights {path} have another layout: {name} is absent or of another size; give those"
        " of a VGG network with encoders to relu3_1"
    )


def _finite(tensor: Tensor, path: Path) -> Tensor:
    if not bool(tensor.isfinite().all()):
        raise UserError(f"the weights {path} hold numbers that are not finite; copy them again")
    return tensor


def _convolved(x: Float[Tensor, "1 i h w"], layer: Layer) -> Float[Tensor, "1 o h w"]:
    return F.relu(F.conv2d(F.pad(x, (1, 1, 1, 1), mode="reflect"), *layer))


def encoded(picture: Float[Tensor, "1 3 h w"], net: Autoencoder) -> Float[Tensor, "1 c a b"]:
    """Return the features of a display picture, at 1 / 2^(k-1) of its size."""
    x = F.conv2d(picture, *net.normalisation)
    for name, layer in zip(LAYERS, net.encoder, strict=False):
        if name.endswith("1") and name != "conv11":
            x = F.max_pool2d(x, 2)
        x = _convolved(x, layer)
    return x


def decoded(features: Float[Tensor, "1 c a b"], net: Autoencoder) -> Float[Tensor, "1 3 h w"]:
    """Return the display picture of features, in [0, 1]."""
    x = features
    names = reversed(LAYERS[: len(net.decoder)])
    for name, layer in zip(names, net.decoder, strict=True):
        x = _convolved(x, layer)
        if name.endswith("1") and name != "conv11":
            x = F.interpolate(x, scale_factor=2, mode="nearest")
    return x.clamp(0, 1)


def moments(features: Float[Tensor, "c n"]) -> Moments:
    """Return the sums over n features, in float64."""
    x = features.double()
    return Moments(x.shape[1], x.sum(1), x @ x.T)


def _power(matrix: Float[Tensor, "c c"], exponent: float, floor: float) -> Float[Tensor, "c c"]:
    values, vectors = torch.linalg.eigh(matrix)
    return (vectors * values.clamp_min(floor) ** exponent) @ vectors.T


def transferred(features: Float[Tensor, "c n"], style: Moments) -> Float[Tensor, "c n"]:
    """Return features with the mean and the covariance of a style.

    Directions in which the features vary by less than `FLOOR` keep less than the style's variance.
    """
    own = moments(features)
    white = _power(own.covariance, -0.5, FLOOR)
    # 0: rounding can make the least eigenvalue negative, which has no root.
    colour = _power(style.covariance, 0.5, 0.0)
    centred = features.double() - own.mean[:, None]
    return (colour @ (white @ centred) + style.mean[:, None]).to(features.dtype)


Style = tuple[dict[int, Moments], ...]
"""The moments of each class that the style photos show, for each of the networks."""


@torch.no_grad()
def style_moments(
    photos: Sequence[tuple[Float[np.ndarray, "h w 3"], Masks]], nets: Sequence[Autoencoder]
) -> Style:
    """Return the moments of the classes over all style photos.

    Args:
        photos: display pictures, and where each class is in them.
        nets: the networks.
    """
    shown: dict[int, int] = {}
    for _, masks in photos:
        for kind, mask in masks.items():
            shown[kind] = shown.get(kind, 0) + int(mask.sum())
    found = []
    for net in nets:
        sums: dict[int, Moments] = {}
        for picture, masks in photos:
            x = encoded(_batch(picture), net)[0]
            for kind, mask in masks.items():
                inside = _reduced(mask, net.level)
                if shown[kind] >= MIN_PIXELS and inside.any():
                    more = moments(x[:, inside])
                    sums[kind] = sums[kind] + more if kind in sums else more
        found.append(sums)
    return tuple(found)


@torch.no_grad()
def stylised(
    picture: Float[np.ndarray, "h w 3"],
    masks: Masks,
    style: Style,
    nets: Sequence[Autoencoder],
    alpha: float = ALPHA,
) -> Float[np.ndarray, "h w 3"]:
    """Return a display picture in a style, level by level; classes without a style stay.

    Args:
        picture: in [0, 1].
        masks: where each class is.
        style: of the same networks.
        nets: the networks, in the order of the levels.
        alpha: fraction of the transferred features.
    """
    height, width = picture.shape[:2]
    x = _batch(picture)
    for net, sums in zip(nets, style, strict=True):
        features = encoded(x, net)
        for kind, mask in masks.items():
            inside = _reduced(mask, net.level)
            if kind in sums and mask.sum() >= MIN_PIXELS and inside.any():
                old = features[0][:, inside]
                features[0][:, inside] = torch.lerp(old, transferred(old, sums[kind]), alpha)
        x = decoded(features, net)
    return to_numpy(x[0, :, :height, :width].permute(1, 2, 0)).astype(np.float64)


def _batch(picture: Float[np.ndarray, "h w 3"]) -> Float[Tensor, "1 3 h2 w2"]:
    """Return a picture for the networks, its sides rounded up to multiples of 4."""
    x = to_device(np.ascontiguousarray(picture, np.float32), CPU).permute(2, 0, 1)[None]
    return F.pad(x, _padding(x.shape[-2:]), mode="replicate")


def _reduced(mask: Bool[np.ndarray, "h w"], level: int) -> Bool[Tensor, "a b"]:
    """Return where more than half of a feature's area is inside a mask."""
    x = to_device(mask.astype(np.float32), CPU)[None, None]
    x = F.pad(x, _padding(mask.shape), mode="replicate")
    return F.avg_pool2d(x, 2 ** (level - 1))[0, 0] > 0.5


def _padding(size: Sequence[int]) -> tuple[int, int, int, int]:
    height, width = size
    return 0, -width % 4, 0, -height % 4
