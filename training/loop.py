"""The network in PyTorch and the training loop: batches, checkpoints, averaged weights. Shell (threads, files)."""

import hashlib
import io
import json
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
import torch
from torch import nn

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.sim.scenes.model import LABELS
from sightline.training.export import shifted
from sightline.training.network import (
    AGAINST,
    BRIGHTNESS,
    COLORS,
    DARKEST,
    LOOKED_AT,
    OUTPUTS,
    TAUGHT,
    Layer,
    Weights,
    network,
)
from sightline.training.scenes import CUT_PX, WHOLE_PX, DrawnScenes, SceneSource, drawn_scenes, sample
from sightline.training.schedule import START_SHARE, Training
from sightline.training.shipping import Card, Progress, card_text, chosen_thresholds, final_report, written

_RARE = -4.6  # initial bias of the heat maps: one cell in a hundred


class TorchNetwork(nn.Module):  # type: ignore[misc]
    """The network of the table. Input: RGB or BGR as in training, uint8 (N, 3, H, W)."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = network()
        channels = {"image": COLORS}
        for layer in self.layers:
            channels[layer.name] = layer.channels
            made = _module(layer, channels[layer.takes[0]])
            if made is not None:
                self.add_module(_key(layer), made)

    def forward(self, image: Any) -> Any:
        """Return heat maps (before the sigmoid), geometry, heat maps of `TAUGHT`: (N, OUTPUTS + TAUGHT, H/4, W/4)."""
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


def begin_from(network: TorchNetwork, weights: Weights, images: Any) -> None:
    """Start a network with weights of `folded`, and each normalization with statistics on these images, uint8
    (N, 3, H, W). The output stays the same. The maps of `TAUGHT` are not among the weights and start at
    random; training removes the thresholds in the head of a file.
    """
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
            hooks.append(module[1].register_forward_hook(partial(_calibrate_normalization, module[0])))
        network.eval()(images)
        network.train()
    for hook in hooks:
        hook.remove()


def _calibrate_normalization(convolution: Any, normal: Any, given: tuple[Any], _: Any) -> None:
    """Set the normalization to the identity on these values, with the convolution's weights at the expected size."""
    mean, variance = given[0].mean((0, 2, 3)), given[0].var((0, 2, 3))
    spread = (variance + normal.eps).sqrt()
    convolution.weight /= spread[:, None, None, None]
    normal.running_mean.copy_(mean / spread)
    normal.running_var.copy_(variance / spread**2)
    normal.weight.copy_((variance / spread**2 + normal.eps).sqrt() * spread)
    normal.bias += mean


def _key(layer: Layer) -> str:
    """Return the layer's name in PyTorch, where modules have other attributes, such as `half`."""
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
    """Fold the batch normalization into weight and bias of every convolution, and add `AGAINST`."""
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


# The training: batches prepared in parallel, checkpoints, an average of the weights. Shell (threads, files).


_PREPARED: Final = 3  # waiting batches
_AVERAGED: Final = 0.998
_GEOMETRY_WEIGHT: Final = 1.0
_TAUGHT_WEIGHT: Final = 0.5
_RENDEZVOUS: Final = "rendezvous"
_JOIN_TIMEOUT: Final = timedelta(minutes=3)
"""Time for all processes to join, and for the gradients of each step. A swapping machine needs longer."""
CHECKPOINT: Final = "checkpoint.pt"
_CHECKPOINT_EVERY: Final = 100
_LOG_EVERY: Final = 50


def train(scenes: DrawnScenes, training: Training, device: str, folder: Path,
          log: Callable[[str], None], *, feeders: int = 1) -> Weights:
    """Train, or continue from the checkpoint in `folder`. Returns the averaged weights with folded normalization.
    `training.jobs` processes share the work on the CPU; `feeders` processes prepare the batches of a GPU.
    """
    if training.jobs == 1:
        return _trained(scenes, training, device, folder, log, feeders=feeders)
    _checkpoint(folder / CHECKPOINT, _made_by(scenes, training), device)  # one error if it is of another training
    with _helpers(scenes, training, folder):
        return _trained(scenes, training, device, folder, log)


def blended(start: Weights, trained: Weights) -> Weights:
    """Mix the weights of a trained network with its initial ones, which keeps more of their knowledge
    (Wortsman et al., Robust fine-tuning of zero-shot models, 2022)."""
    return {name: START_SHARE * start[name] + (1 - START_SHARE) * one for name, one in trained.items()}


def start_from(weights: Weights, scenes: DrawnScenes, training: Training, folder: Path) -> None:
    """Write a checkpoint of these weights at the start of the last round, unless there is a checkpoint."""
    if (folder / CHECKPOINT).exists():
        return
    torch.manual_seed(training.seed)
    state = _State(scenes, training, torch.device("cpu"))
    state.begin(weights, _batch(scenes, replace(training, jobs=1), training.last_from, 0))
    state.save(folder / CHECKPOINT, training.last_from)


@contextmanager
def _helpers(scenes: DrawnScenes, training: Training, folder: Path) -> Iterator[None]:
    """Run `jobs` - 1 further processes, each with its share of every batch, within the context."""
    (folder / _RENDEZVOUS).unlink(missing_ok=True)
    made = torch.multiprocessing.get_context("spawn")
    helpers = [made.Process(target=_run_helper, args=(rank, scenes, training, folder), daemon=True)
               for rank in range(1, training.jobs)]
    for one in helpers:
        one.start()
    try:
        _join_group(0, training, folder)
        yield
    except RuntimeError as error:
        for one in helpers:
            one.join(1.0)  # an ended process may not be registered yet
        if all(one.is_alive() for one in helpers):
            raise
        raise HardwareError(f"one of the {training.jobs} training processes ended ({error}); the same command "
                            "continues from the last checkpoint, and --jobs 1 needs less memory") from None
    finally:
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
        for one in helpers:
            one.terminate()
            one.join()


def _run_helper(rank: int, scenes: DrawnScenes, training: Training, folder: Path) -> None:
    """Run one helper process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends the others
    _join_group(rank, training, folder)
    _trained(scenes, training, "cpu", folder, None)


def _join_group(rank: int, training: Training, folder: Path) -> None:
    """Join the group of processes through a file, on this machine only."""
    if sys.platform == "linux":
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    rendezvous = (folder / _RENDEZVOUS).resolve().as_uri()
    torch.distributed.init_process_group("gloo", init_method=rendezvous, rank=rank, world_size=training.jobs,
                                         timeout=_JOIN_TIMEOUT)


def _trained(scenes: DrawnScenes, training: Training, device: str, folder: Path,
             log: Callable[[str], None] | None, *, feeders: int = 1) -> Weights:
    """Train in one process. Only the process with `log` writes checkpoints."""
    torch.set_num_threads(1)  # two threads are slower on shared cores, because the layers are small
    torch.backends.cudnn.benchmark = True  # the default algorithm of a GPU for depthwise layers is rarely its fastest
    torch.manual_seed(training.seed)
    state = _State(scenes, training, torch.device(device))
    checkpoint = folder / CHECKPOINT
    begin = state.load(checkpoint)
    if begin and log is not None:
        log(f"continues at step {begin} of {training.steps}")
    batches = _batches(scenes, training, begin) if device == "cpu" else _fed(scenes, training, begin, feeders)
    for step, batch in enumerate(batches, start=begin):
        loss = state.learn(step, batch)
        if log is None:
            continue
        if (step + 1) % _LOG_EVERY == 0:
            log(f"step {step + 1} of {training.steps}: loss {float(loss):.3f}")
        if (step + 1) % _CHECKPOINT_EVERY == 0 or step + 1 == training.steps:
            state.save(checkpoint, step + 1)
    return folded(state.average)


def _made_by(scenes: DrawnScenes, training: Training) -> str:
    """Describe the training that a checkpoint belongs to."""
    return json.dumps({**asdict(training), "scenes": scenes.digest()})


def _checkpoint(path: Path, made_by: str, device: Any) -> dict[str, Any] | None:
    """Read the checkpoint, if there is one. Raises ConfigError if it is damaged or of another training."""
    if not path.exists():
        return None
    try:
        kept: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
        training = kept["training"]
    except Exception as error:  # PyTorch raises many classes for a damaged file, with texts that suggest an unsafe load
        raise ConfigError(f"checkpoint {path} cannot be read ({type(error).__name__}); remove it to train from the "
                          "start, or name another --out") from None
    if training != made_by:
        raise ConfigError(f"{path} is of a training with other settings or scenes: {training}; remove it, "
                          "or name another --out")
    return kept


BATCHED: Final = ("image", "heat", "geometry", "sure", "counts", "known")


class Batch(NamedTuple):
    """Samples of one batch: the arrays of `TrainingSample` with a leading axis."""

    image: Any
    heat: Any
    geometry: Any
    sure: Any
    counts: Any
    known: Any


class _State:
    """Network, optimizer and average."""

    def __init__(self, scenes: DrawnScenes, training: Training, device: Any) -> None:
        self._training, self._made_by = training, _made_by(scenes, training)
        self._device = device
        # Channels last is faster on a CPU, but slower on a GPU, whose depthwise kernels expect the other order.
        order = torch.channels_last if device.type == "cpu" else torch.contiguous_format
        self.network = TorchNetwork().to(device=device, memory_format=order).train()
        self._optimizer = torch.optim.AdamW(self.network.parameters(), lr=training.rate, weight_decay=training.decay,
                                            fused=self._device.type == "cuda")
        self._schedule = torch.optim.lr_scheduler.LambdaLR(self._optimizer, training.rate_at)
        self.average = self._copied()

    def _copied(self) -> dict[str, Any]:
        return {name: value.detach().clone() for name, value in self.network.state_dict().items()}

    def begin(self, weights: Weights, batch: Batch) -> None:
        """Load these weights for the last round."""
        begin_from(self.network, weights, self._on_device(batch.image))
        self.average = self._copied()
        self._schedule.last_epoch = self._training.last_from

    def learn(self, step: int, batch: Batch) -> Any:
        """Run one step. Returns its loss, on the device."""
        loss = _loss(self.network(self._on_device(batch.image)), batch, self._on_device)
        self._optimizer.zero_grad()
        loss.backward()
        self._average_gradients()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 10.0)
        self._optimizer.step()
        self._schedule.step()
        share = min(_AVERAGED, (step + 1) / (step + 10))
        now = {name: value for name, value in self.network.state_dict().items() if value.is_floating_point()}
        for name, value in now.items():
            self.average[name].lerp_(value, 1 - share)
        return loss.detach()

    def _average_gradients(self) -> None:
        """Average the gradients of all processes, so that all networks stay the same."""
        if not torch.distributed.is_initialized():
            return
        gradients = [one.grad for one in self.network.parameters()]
        together = torch.cat([one.flatten() for one in gradients])
        torch.distributed.all_reduce(together)
        for one, mean in zip(gradients, together.split([one.numel() for one in gradients]), strict=True):
            one.copy_(mean.view_as(one) / torch.distributed.get_world_size())

    def _on_device(self, array: Any) -> Any:
        return torch.as_tensor(array).to(self._device, non_blocking=True)

    def save(self, path: Path, step: int) -> None:
        """Write the checkpoint to another file and move it, so that an interruption leaves the last. Raises OSError."""
        content = io.BytesIO()  # PyTorch would raise another error for a full disk
        torch.save({
            "training": self._made_by, "step": step, "network": self.network.state_dict(),
            "average": self.average, "optimiser": self._optimizer.state_dict(), "schedule": self._schedule.state_dict(),
        }, content)
        part = path.with_suffix(".part")
        try:
            with part.open("wb") as file:
                file.write(content.getbuffer())
                file.flush()
                os.fsync(file.fileno())  # otherwise it may be empty after a power loss
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)

    def load(self, path: Path) -> int:
        """Load a checkpoint. Returns the next step, 0 without one. Raises ConfigError for one of another training."""
        kept = _checkpoint(path, self._made_by, self._device)
        if kept is None:
            return 0
        self.network.load_state_dict(kept["network"])
        self.average = kept["average"]
        self._optimizer.load_state_dict(kept["optimiser"])
        self._schedule.load_state_dict(kept["schedule"])
        return int(kept["step"])


def _loss(given: Any, batch: Batch, on_device: Callable[[Any], Any]) -> Any:
    """Return the focal loss on the heat maps plus distances on the geometry of the center cells."""
    geometry = given[:, len(LABELS) : OUTPUTS]
    wanted = on_device(batch.heat)
    counts = on_device(batch.counts)[:, None] * on_device(batch.known)[:, :, None, None]
    labels = _focal(given[:, : len(LABELS)], wanted[:, :-TAUGHT], counts[:, :-TAUGHT])
    taught = _focal(given[:, OUTPUTS:], wanted[:, -TAUGHT:], counts[:, -TAUGHT:])
    sure = on_device(batch.sure)[:, None]
    off = (geometry - on_device(batch.geometry)).abs() * sure
    return labels + _TAUGHT_WEIGHT * taught + _GEOMETRY_WEIGHT * off.sum() / sure.sum().clamp(min=1.0)


def _focal(heat: Any, wanted: Any, counts: Any) -> Any:
    """Return the focal loss per center (Zhou et al., Objects as Points, 2019, equation 1)."""
    likely = torch.sigmoid(heat)
    is_middle = (wanted == 1.0).float()
    found = is_middle * (1 - likely) ** 2 * torch.nn.functional.logsigmoid(heat)
    empty = (1 - is_middle) * (1 - wanted) ** 4 * likely**2 * torch.nn.functional.logsigmoid(-heat)
    return -((found + empty) * counts).sum() / is_middle.sum().clamp(min=1.0)


def _fed(scenes: DrawnScenes, training: Training, first: int, feeders: int) -> Iterator[Batch]:
    """Yield batches from several processes, because a GPU learns faster than one process prepares."""
    steps = range(first, training.steps)
    return iter(torch.utils.data.DataLoader(
        _Steps(scenes, training), batch_size=None, sampler=steps, num_workers=feeders, prefetch_factor=_PREPARED,
        pin_memory=torch.cuda.is_available(),
    ))


class _Steps(torch.utils.data.Dataset):  # type: ignore[misc]
    """Dataset of the batch of each step."""

    def __init__(self, scenes: DrawnScenes, training: Training) -> None:
        self._scenes, self._training = scenes, training

    def __getitem__(self, step: int) -> Batch:
        cv2.setNumThreads(1)
        return Batch(*(torch.from_numpy(one) for one in _batch(self._scenes, self._training, step, 0)))


def _batches(scenes: DrawnScenes, training: Training, first: int) -> Iterator[Batch]:
    """Yield batches that a second thread prepares. Only a few may wait."""
    rank = torch.distributed.get_rank() if torch.distributed.is_initialized() else 0
    with ThreadPoolExecutor(1, "batches") as pool:
        waiting: deque[Future[Batch]] = deque()
        for step in range(first, training.steps):
            for coming in range(step + len(waiting), min(step + _PREPARED, training.steps)):
                waiting.append(pool.submit(_batch, scenes, training, coming, rank))
            yield waiting.popleft().result()


def _batch(scenes: DrawnScenes, training: Training, step: int, rank: int) -> Batch:
    """Return this process's share of a batch."""
    size_px, count = (WHOLE_PX, training.batch // 2) if training.whole_at(step) else (CUT_PX, training.batch)
    share, shown = max(1, count // training.jobs), training.shown_at(step, scenes.own)
    samples = [sample(scenes, shown, (training.seed, step, place), size_px)
               for place in range(rank * share, (rank + 1) * share)]
    return Batch(*(np.stack([getattr(one, name) for one in samples]) for name in BATCHED))


# `sightline train`: scenes, training, thresholds, ONNX file, score, model card. Shell (files).


MODEL, CARD = "sightline.onnx", "sightline.md"


@dataclass(frozen=True, slots=True)
class TrainOptions:
    """Options of `sightline train`."""

    out: Path
    scenes: SceneSource
    training: Training
    device: str
    jobs: int
    validated: int
    """Scenes of each column that choose the thresholds."""
    scored: int
    """Scenes of each column in the table of the model card."""
    start: Weights | None = None
    """Initial weights of the last round, in place of the earlier rounds."""


def run_training(options: TrainOptions, log: Callable[[str], None], progress: Progress) -> Path:
    """Run everything in order, and return the path of the model. Continues an interrupted run in the folder."""
    with progress(options.scenes.total, "scenes") as advance:
        scenes = drawn_scenes(options.out, options.scenes, options.jobs, advance)
    if options.start is not None:
        start_from(options.start, scenes, options.training, options.out)
    weights = train(scenes, options.training, options.device, options.out, log, feeders=options.jobs)
    if options.start is not None:
        weights = blended(options.start, weights)
    log("thresholds are being chosen on scenes of other seeds")
    thresholds = chosen_thresholds(options.out / "unchosen.onnx", weights, options.validated, options.jobs, progress)
    model = options.out / MODEL
    written(model, shifted(weights, thresholds))
    log(f"{model}: {model.stat().st_size} bytes; it is being scored on scenes of no training")
    report = final_report(model, options.scored, progress)
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    parameters = sum(int(one.size) for one in weights.values())
    card = Card(options.training, options.scenes, options.device, thresholds, parameters, model.stat().st_size,
                digest, options.validated, report)
    (options.out / CARD).write_text(card_text(card), "utf-8")
    return model
