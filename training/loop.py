"""The network's table as a PyTorch module, and its weights as arrays with the normalisation folded in. Pure (PyTorch).
"""

from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from sightline.training.network import (
    AGAINST,
    BRIGHTNESS,
    COLOURS,
    DARKEST,
    LOOKED_AT,
    OUTPUTS,
    TAUGHT,
    Layer,
    Weights,
    network,
)
from sightline.sim.scenes.model import LABELS

_RARE = -4.6  # bias of the heat maps at the beginning: a hundredth of the cells


class Network(nn.Module):  # type: ignore[misc]
    """Runs the table. Takes RGB or BGR as it was trained, uint8 (N, 3, H, W)."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = network()
        channels = {"image": COLOURS}
        for layer in self.layers:
            channels[layer.name] = layer.channels
            made = _module(layer, channels[layer.takes[0]])
            if made is not None:
                self.add_module(_key(layer), made)

    def forward(self, image: Any) -> Any:
        """Heat maps (before the sigmoid), geometry, heat maps of `TAUGHT`: (N, OUTPUTS + TAUGHT, H/4, W/4)."""
        seen = image.float() / 255
        mean = seen[:, :, ::LOOKED_AT].mean(dim=(1, 2, 3), keepdim=True).clamp(min=DARKEST)
        known = {"image": seen * (BRIGHTNESS / mean)}
        for layer in self.layers:
            known[layer.name] = self._run(layer, [known[name] for name in layer.takes])
        return known[self.layers[-1].name]

    def _run(self, layer: Layer, takes: list[Any]) -> Any:
        if layer.kind in ("add", "add-up"):
            second = takes[1] if layer.kind == "add" else nn.functional.interpolate(takes[1], scale_factor=2)
            return torch.relu(takes[0] + second) if layer.relu else takes[0] + second
        return getattr(self, _key(layer))(takes[0])


def begin_from(network: Network, weights: Weights, images: Any) -> None:
    """Give a new network what `folded` gave, and each normalisation what it sees on these pictures, uint8 (N, 3, H, W):
    what comes out stays the same. The maps of `TAUGHT` are not among the weights and begin anew; the thresholds that a
    file's head has worked in are learned away."""
    hooks = []
    with torch.no_grad():
        for layer in network.layers:
            module = getattr(network, _key(layer), None)
            if module is None:
                continue
            weight, bias = (torch.tensor(weights[f"{layer.name}.{part}"]) for part in ("weight", "bias"))
            if layer.kind == "head":
                module.weight[:OUTPUTS], module.bias[:OUTPUTS] = weight, bias
                continue
            module[0].weight.copy_(weight)
            module[1].bias.copy_(bias)
            hooks.append(module[1].register_forward_hook(partial(_settle, module[0])))
        network.eval()(images)
        network.train()
    for hook in hooks:
        hook.remove()


def _settle(convolution: Any, normal: Any, given: tuple[Any], _: Any) -> None:
    """Let the normalisation undo what it does to these values, and the convolution's weights be as large as it expects.
    """
    mean, variance = given[0].mean((0, 2, 3)), given[0].var((0, 2, 3))
    spread = (variance + normal.eps).sqrt()
    convolution.weight /= spread[:, None, None, None]
    normal.running_mean.copy_(mean / spread)
    normal.running_var.copy_(variance / spread**2)
    normal.weight.copy_((variance / spread**2 + normal.eps).sqrt() * spread)
    normal.bias += mean


def _key(layer: Layer) -> str:
    """What PyTorch calls it: modules have attributes of their own, such as `half`."""
    return "layer_" + layer.name.replace(".", "_")


def _module(layer: Layer, channels: int) -> Any:
    if layer.kind in ("add", "add-up"):
        return None
    if layer.kind == "head":
        head = nn.Conv2d(channels, layer.channels + TAUGHT, 1)
        nn.init.normal_(head.weight, std=0.01)
        nn.init.zeros_(head.bias)
        nn.init.constant_(head.bias[: len(LABELS)], _RARE)
        nn.init.constant_(head.bias[OUTPUTS:], _RARE)
        return head
    groups = channels if layer.kind == "depthwise" else 1
    steps = [nn.Conv2d(channels, layer.channels, layer.kernel, layer.stride, (layer.kernel - 1) // 2, groups=groups,
                       bias=False), nn.BatchNorm2d(layer.channels)]
    return nn.Sequential(*steps, nn.ReLU()) if layer.relu else nn.Sequential(*steps)


def folded(state: dict[str, Any]) -> Weights:
    """Every convolution's weight and bias, with the batch normalisation after it worked in, and `AGAINST`."""
    weights: Weights = {}
    values = {name: value.detach().cpu().double().numpy().copy() for name, value in state.items()}
    for layer in network():
        key = _key(layer)
        if layer.kind == "head":
            for part in ("weight", "bias"):
                rows = values[f"{key}.{part}"]
                rows[LABELS.index("ball")] -= AGAINST * rows[OUTPUTS:].sum(axis=0)
                weights[f"{layer.name}.{part}"] = rows[:OUTPUTS].astype(np.float32)
        elif f"{key}.0.weight" in values:
            gain = values[f"{key}.1.weight"] / np.sqrt(values[f"{key}.1.running_var"] + 1e-5)
            bias = values[f"{key}.1.bias"] - gain * values[f"{key}.1.running_mean"]
            weights[f"{layer.name}.weight"] = (values[f"{key}.0.weight"] * gain[:, None, None, None]).astype(np.float32)
            weights[f"{layer.name}.bias"] = bias.astype(np.float32)
    return weights
