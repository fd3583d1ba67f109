"""Weights of the learned detector's network that mean nothing."""

import numpy as np

from sightline.training.network import network

_HEAD = np.float32(0.02)


def weights(seed=1):
    """Random ones of the right shapes, which keep the signal about as large as it is."""
    draw, channels, made = np.random.default_rng(seed), {"image": 3}, {}
    for layer in network():
        channels[layer.name] = layer.channels
        if layer.kind in ("conv", "depthwise", "head"):
            each = 1 if layer.kind == "depthwise" else channels[layer.takes[0]]
            shape = (layer.channels, each, layer.kernel, layer.kernel)
            made[f"{layer.name}.weight"] = draw.normal(0, (2 / np.prod(shape[1:])) ** 0.5, shape).astype(np.float32)
            if layer.kind == "head":  # what is added up on the way is large, and scores near 1 are all alike
                made[f"{layer.name}.weight"] *= _HEAD
            made[f"{layer.name}.bias"] = draw.normal(0, 0.1, layer.channels).astype(np.float32)
    return made
