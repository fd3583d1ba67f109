"""Runs an ONNX model with ONNX Runtime, and reads the inputs, outputs and metadata of its file. Shell (loads files).

It reads the device from the open session. A runtime that is built for a GPU lists the GPU, but silently runs on the CPU
if the GPU is not available.
"""

import importlib
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

from numpy.typing import NDArray

from sightline.protocol.errors import ConfigError, HardwareError, install_command
from sightline.vision_side.config import Device

Arrays = dict[str, NDArray[Any]]
PROVIDERS: Final = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider",
                    "tensorrt": "TensorrtExecutionProvider"}
_TYPES: Final = {"tensor(float)": "float32", "tensor(uint8)": "uint8", "tensor(int64)": "int64",
                 "tensor(float16)": "float16"}
_DEVICES: Final = {provider: device for device, provider in PROVIDERS.items()}
_BEHIND: Final = {"tensorrt": ("tensorrt", "cuda", "cpu"), "cuda": ("cuda", "cpu"), "cpu": ("cpu",)}
"""Providers of a session for each device, in order; later providers run the operations that the first cannot."""
_FIX: Final = ("install onnxruntime-gpu in place of onnxruntime (never both), see that `nvidia-smi` shows the GPU, or "
               "take --device auto")
_USUAL_REASONS: Final = (
    ("INVALID_PROTOBUF|No graph was found", "it is not an ONNX file, or truncated; fetch it again"),
    ("IR version|[Oo]pset", "it is newer than this ONNX Runtime; export it with opset 17, or update onnxruntime"),
    ("not a registered function/op|No Op registered", "ONNX Runtime lacks one of its operators; export it without"),
    ("[Ee]xternal data|external tensors", "its weights are in a file of their own; put that file beside it"),
)
"""Patterns in the errors of ONNX Runtime, and their causes."""
_ERRORS_ONLY: Final = 3
_LONGEST: Final = 200


@dataclass(frozen=True, slots=True)
class Tensor:
    """An input or output; `shape` has None for each open dimension."""

    name: str
    type: str
    shape: tuple[int | None, ...]


@dataclass(frozen=True, slots=True)
class OnnxHeader:
    """Inputs, outputs and metadata of one model."""

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    metadata: dict[str, str] = field(default_factory=dict)


class ModelEngine(Protocol):
    """Runs a model of any framework. `device` is the device in use, `note` a remark on it for the operator."""

    name: str
    device: str
    note: str

    def run(self, pixels: NDArray[Any]) -> Arrays:
        """Run the model on one input. Returns all outputs by name. Raises any error of the framework."""
        ...


def _tensors(slots: Iterable[Any]) -> tuple[Tensor, ...]:
    return tuple(Tensor(one.name, _TYPES.get(one.type, one.type), tuple(map(_size, one.shape))) for one in slots)


def _size(dimension: object) -> int | None:
    return dimension if isinstance(dimension, int) and dimension > 0 else None


def import_runtime() -> Any:
    """Import ONNX Runtime. Raises ImportError."""
    # Otherwise it sends telemetry and stores a device id. It reads this variable once, at import.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    return importlib.import_module("onnxruntime")


def open_engine(path: Path, device: Device, threads: int) -> "Engine":
    """Load the model.

    Raises:
        ConfigError: without ONNX Runtime, or for a file that is not a model.
        HardwareError: for a device that is not available to the model.
    """
    try:
        runtime = import_runtime()
    except ImportError:
        raise ConfigError(
            f"onnxruntime is not installed: {install_command('vision')}, or [vision-gpu] for an NVIDIA GPU; "
            "it has no wheel for 32-bit ARM"
        ) from None
    try:
        engine = Engine(runtime, path, device, threads)
    except HardwareError:
        raise
    except Exception as error:  # ONNX Runtime raises its own classes for a bad file
        raise ConfigError(f"model {path} cannot be opened: {_unfit(path, error)}"[:_LONGEST]) from None
    if device not in ("auto", engine.device):
        raise HardwareError(f"--device {device}: {engine.name} runs {path.name} on {engine.device} instead; {_FIX}")
    return engine


def _unfit(path: Path, error: Exception) -> str:
    """Return why a file does not open as a model: a usual reason, or the text of ONNX Runtime."""
    with path.open("rb") as file:
        head = file.read(2)
    if head == b"PK" or head[:1] == b"\x80":
        return "it is a file of PyTorch, not of ONNX; export it to ONNX, or use --detector torch:FILE"
    text = " ".join(str(error).split())
    return next((reason for pattern, reason in _USUAL_REASONS if re.search(pattern, text)), text)


class Engine:
    """A session of ONNX Runtime. `device` is the device in use, `note` a remark on it for the operator."""

    def __init__(self, runtime: Any, path: Path, device: Device, threads: int) -> None:
        """Raises HardwareError for a device that this runtime does not support."""
        self.name = f"onnxruntime {runtime.__version__}"
        available = set(runtime.get_available_providers())
        wanted = device if device != "auto" else ("cuda" if PROVIDERS["cuda"] in available else "cpu")
        if PROVIDERS[wanted] not in available:
            raise HardwareError(f"--device {wanted}: this onnxruntime has no {PROVIDERS[wanted]}; {_FIX}")
        if wanted != "cpu" and hasattr(runtime, "preload_dlls"):
            runtime.preload_dlls()  # CUDA libraries from wheels are not on the path of the loader
        options = runtime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = _ERRORS_ONLY
        providers = [PROVIDERS[one] for one in _BEHIND[wanted] if PROVIDERS[one] in available]
        self._session = _session(runtime, path, options, providers)
        self._session.disable_fallback()  # otherwise a GPU that is lost later is silently replaced by the CPU
        got = self._session.get_providers()[0]
        self.device = _DEVICES.get(got, got)
        self.note = "" if device != "auto" or self.device != "cpu" else _why_cpu(wanted)
        self.header = OnnxHeader(_tensors(self._session.get_inputs()), _tensors(self._session.get_outputs()),
                                 dict(self._session.get_modelmeta().custom_metadata_map))

    def run(self, pixels: NDArray[Any]) -> Arrays:
        """Run the model on one input. Returns all outputs by name. Raises any error of ONNX Runtime."""
        names = [one.name for one in self.header.outputs]
        return dict(zip(names, self._session.run(names, {self.header.inputs[0].name: pixels}), strict=True))


def _session(runtime: Any, path: Path, options: Any, providers: list[str]) -> Any:
    """Open a session, on the CPU if the other providers fail. ONNX Runtime's own fallback would print to stdout."""
    try:
        return runtime.InferenceSession(str(path), options, providers=providers, enable_fallback=0)
    except Exception:  # ONNX Runtime's own errors do not derive from RuntimeError
        if len(providers) == 1:
            raise
    return runtime.InferenceSession(str(path), options, providers=[PROVIDERS["cpu"]], enable_fallback=0)


def _why_cpu(wanted: str) -> str:
    return "the GPU was listed, but the model did not get it" if wanted != "cpu" else "no GPU runtime is installed"
