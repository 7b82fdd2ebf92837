"""Small random networks in the layout of the WCT weights."""

from pathlib import Path

import torch

WIDTHS = {"conv0": 3, "conv11": 4, "conv12": 4, "conv21": 6, "conv22": 6, "conv31": 8}
NAMES = tuple(WIDTHS)[1:]


def random_layer(generator, inputs, outputs, side):
    weight = torch.randn(outputs, inputs, side, side, generator=generator)
    weight *= (2 / (inputs * side * side)) ** 0.5
    return weight, 0.1 * torch.rand(outputs, generator=generator)


def save_wct(folder: Path, seed: int = 0) -> Path:
    """Write encoders and decoders of levels 1 to 3."""
    folder.mkdir(parents=True, exist_ok=True)
    generator = torch.Generator(device="cpu").manual_seed(seed)
    for level in (1, 2, 3):
        names = NAMES[: NAMES.index(f"conv{level}1") + 1]
        weight, bias = random_layer(generator, 3, 3, 1)
        encoder = {"conv0.weight": weight, "conv0.bias": bias}
        decoder, inputs = {}, 3
        for name in names:
            weight, bias = random_layer(generator, inputs, WIDTHS[name], 3)
            encoder |= {f"{name}.weight": weight, f"{name}.bias": bias}
            inputs = WIDTHS[name]
        for name, following in zip(reversed(names), [*reversed(names[:-1]), None], strict=True):
            outputs = 3 if following is None else WIDTHS[following]
            weight, bias = random_layer(generator, inputs, outputs, 3)
            decoder |= {f"{name}.weight": weight, f"{name}.bias": bias}
            inputs = outputs
        for kind, tensors in (("encoder", encoder), ("decoder", decoder)):
            torch.save({"epoch": 1, "model": tensors}, folder / f"{kind}{level}.pth")
    return folder
