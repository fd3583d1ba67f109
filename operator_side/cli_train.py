"""Command `train`: make the learned detector again, or one's own. Shell."""

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sightline.operator_side.preflight import needs
from sightline.training.schedule import Training
from sightline.protocol.errors import ConfigError, HardwareError

if TYPE_CHECKING:  # it needs the extra
    from sightline.training.network import Weights

STEPS = [15_000, 14_000, 13_000, 14_000, 20_000, 20_000]
SCENES = 100_000
BATCH = 32
VALIDATED = 5000
"""These are those of the model that ships, so that the same command makes one of its kind; a test compares. (That one's
rounds were trained one by one, the last from the file before, as its card says.)"""
OUT = Path("runs/train")
_STEPS = "Of one round; say it again for one more, which starts the learning rate anew and takes in more scenes."
_START = "A model that this command made: train the last round alone, from there on."
_LEAST_SHARE = 8
"""Of a batch for each process that trains: the normalisation needs a few pictures."""


def register_train(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command(epilog="Example: sightline train --out runs/eyes")(train)


def train(
    *,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Scenes, checkpoint, model and card go here.")] = OUT,
    scenes: Annotated[int, typer.Option(min=8, max=800_000, help="Drawn once, seeds from 0 up.")] = SCENES,
    steps: Annotated[list[int], typer.Option(min=1, max=10_000_000, metavar="<int range>", help=_STEPS)] = STEPS,
    batch: Annotated[int, typer.Option(min=2, max=1024, help="Cut-outs of scenes in each step.")] = BATCH,
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="Draws weights, cuts and defects.")] = 1,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="What trains.")] = "cpu",
    jobs: Annotated[int | None, typer.Option(min=1, max=256, help="Processes [default: one per core].")] = None,
    start: Annotated[Path | None, typer.Option(metavar="MODEL", help=_START)] = None,
    validated: Annotated[int, typer.Option(min=5, max=100_000, help="Scenes a column for thresholds.")] = VALIDATED,
    judged: Annotated[int, typer.Option(min=5, help="Scenes a column for the card's table.")] = 500,
) -> None:
    """Draw labelled scenes, train the detector, write sightline.onnx and its card. Cut off, it goes on where it was."""
    with needs("train"):
        import torch

        from sightline.operator_side.train_run import TrainOptions, run_training
    if device == "cuda" and not torch.cuda.is_available():
        raise HardwareError("--device cuda: this PyTorch sees no GPU; check `nvidia-smi` and that PyTorch is a CUDA "
                            "build, or take --device cpu")
    processes = jobs or os.cpu_count() or 1
    weights, digest = _begun(start) if start else (None, "")
    sharing = _sharing(batch, processes) if device == "cpu" else 1
    training = Training(tuple(steps), batch, seed=seed, jobs=sharing, start=digest)
    options = TrainOptions(out, scenes, training, device, processes, validated, judged, weights)
    try:
        out.mkdir(parents=True, exist_ok=True)
        model = run_training(options, _print_line, _progress)
    except OSError as error:
        raise ConfigError(f"--out {out}: {error.strerror or error}") from None
    _print_line(f"{model}, {model.with_suffix('.md').name}: try it with `sightline score detectors onnx:{model}`")


def _begun(model: Path) -> "tuple[Weights, str]":
    """The model's weights, and its SHA-256."""
    from sightline.training.export import weights_in

    try:
        data = model.read_bytes()
        return weights_in(data), hashlib.sha256(data).hexdigest()
    except OSError as error:
        raise ConfigError(f"--start {model}: {error.strerror or error}") from None
    except ValueError as error:
        raise ConfigError(f"--start {model}: {error}; name a model that `sightline train` made") from None


def _sharing(batch: int, processes: int) -> int:
    """How many processes share a batch evenly."""
    return max(n for n in range(1, processes + 1) if n == 1 or (batch % n == 0 and batch // n >= _LEAST_SHARE))


def _print_line(line: str) -> None:
    typer.echo(line)


@contextmanager
def _progress(total: int, what: str) -> Iterator[Callable[[int], None]]:
    """A bar where there is a terminal; silent elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.advance(task, done)
