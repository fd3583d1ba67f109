"""Runs an ONNX model with ONNX Runtime or OpenCV, and reads the inputs, outputs and metadata of its file. Shell.

An ONNX file is a protocol buffer; the few fields that matter are read, all else is stepped over.
"""

import importlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.vision_side.config import Device
from sightline.vision_side.detect.protobuf import Bytes, Field, as_bytes, fields, text

_GRAPH, _METADATA = 7, 14  # of a model
_INITIALIZER, _INPUT, _OUTPUT = 5, 11, 12  # of a graph
_TENSOR_NAME: Final = 8
_MAX_METADATA: Final = 64
_TYPES: Final = {1: "float32", 2: "uint8", 7: "int64", 10: "float16"}


@dataclass(frozen=True, slots=True)
class Tensor:
    """An input or output; `shape` has None where the model does not say."""

    name: str
    type: str
    shape: tuple[int | None, ...]


@dataclass(frozen=True, slots=True)
class OnnxHeader:
    """Of one model."""

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    metadata: dict[str, str] = field(default_factory=dict)


def read_onnx_header(data: Bytes) -> OnnxHeader:
    """Raises ValueError for what is no ONNX model."""
    graph: Bytes | None = None
    metadata: dict[str, str] = {}
    for number, value in _fields(memoryview(data)):
        if number == _GRAPH and not isinstance(value, int):
            graph = value
        elif number == _METADATA and not isinstance(value, int) and len(metadata) < _MAX_METADATA:
            entry = dict(_fields(value))
            metadata[text(entry.get(1, b""))] = text(entry.get(2, b""))
    if graph is None:
        raise ValueError("it holds no graph")
    inputs, outputs, constant = [], [], set()
    for number, value in _fields(graph):
        if isinstance(value, int):
            continue
        if number == _INPUT:
            inputs.append(_tensor(value))
        elif number == _OUTPUT:
            outputs.append(_tensor(value))
        elif number == _INITIALIZER:
            constant.add(text(dict(_fields(value)).get(_TENSOR_NAME, b"")))
    return OnnxHeader(tuple(one for one in inputs if one.name not in constant), tuple(outputs), metadata)


def _tensor(value: Bytes) -> Tensor:
    own = dict(_fields(value))
    kind = dict(_fields(as_bytes(own.get(2, b""))))
    tensor = dict(_fields(as_bytes(kind.get(1, b""))))
    element = tensor.get(1, 0)
    dimensions = [one for number, one in _fields(as_bytes(tensor.get(2, b""))) if number == 1]
    shape = tuple(_size(dict(_fields(as_bytes(one))).get(1)) for one in dimensions)
    return Tensor(text(own.get(1, b"")), _TYPES.get(element if isinstance(element, int) else 0, "other"), shape)


def _size(value: int | Bytes | None) -> int | None:
    return value if isinstance(value, int) and value > 0 else None


def _fields(data: Bytes) -> Iterator[Field]:
    """Of a part of any size: large models have many."""
    try:
        yield from fields(data, most=len(data) + 1)
    except ValueError:
        raise ValueError("it is cut short, or no ONNX model") from None


# What runs an ONNX model: ONNX Runtime where it is installed, else OpenCV. Shell (imports them, loads files).  It is
# honest about the device: what the session really got is asked after it was made. A runtime built for a GPU lists the
# GPU and quietly runs on the CPU when it cannot have it.


Arrays = dict[str, NDArray[Any]]
PROVIDERS: Final = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider",
                    "tensorrt": "TensorrtExecutionProvider"}
_DEVICES: Final = {provider: device for device, provider in PROVIDERS.items()}
_BEHIND: Final = {"tensorrt": ("tensorrt", "cuda", "cpu"), "cuda": ("cuda", "cpu"), "cpu": ("cpu",)}
"""What a session for a device may fall back on for single operations."""
_FIX: Final = ("install onnxruntime-gpu in place of onnxruntime (never both), see that `nvidia-smi` shows the GPU, or "
               "take --device auto")
_ERRORS_ONLY: Final = 3
_LONGEST: Final = 200


class Engine(Protocol):
    """A model that is loaded. `device` is what it runs on, `note` what a person should know about that."""

    name: str
    device: str
    note: str
    batches: bool
    """Whether it runs several pictures at once, where the model does."""

    def run(self, pixels: NDArray[Any]) -> Arrays:
        """The outputs, by name, for one input. Raises whatever the engine raises."""
        ...


def open_engine(path: Path, header: OnnxHeader, device: Device, threads: int) -> Engine:
    """Raises ConfigError for a file that is no model, HardwareError for a device that the model did not get."""
    try:
        runtime = importlib.import_module("onnxruntime")
    except ImportError:
        runtime = None
    try:
        engine: Engine = _OpenCv(path, header) if runtime is None else _Runtime(runtime, path, header, device, threads)
    except (ConfigError, HardwareError):
        raise
    except Exception as error:  # engines raise what they like for a bad file
        raise ConfigError(f"model {path} cannot be opened: {' '.join(str(error).split())}"[:_LONGEST]) from None
    if device not in ("auto", engine.device):
        raise HardwareError(f"--device {device}: {engine.name} runs {path.name} on {engine.device} instead; {_FIX}")
    return engine


class _Runtime:
    """A session of ONNX Runtime."""

    batches = True

    def __init__(self, runtime: Any, path: Path, header: OnnxHeader, device: Device, threads: int) -> None:
        self.name = f"onnxruntime {runtime.__version__}"
        available = set(runtime.get_available_providers())
        wanted = device if device != "auto" else ("cuda" if PROVIDERS["cuda"] in available else "cpu")
        if PROVIDERS[wanted] not in available:
            raise HardwareError(f"--device {wanted}: this onnxruntime has no {PROVIDERS[wanted]}; {_FIX}")
        if wanted != "cpu" and hasattr(runtime, "preload_dlls"):
            runtime.preload_dlls()  # CUDA's libraries from wheels, which are on no path of the loader's
        options = runtime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = _ERRORS_ONLY
        providers = [PROVIDERS[one] for one in _BEHIND[wanted] if PROVIDERS[one] in available]
        self._session = _session(runtime, path, options, providers)
        self._session.disable_fallback()  # or a GPU that is lost later becomes the CPU without a word
        got = self._session.get_providers()[0]
        self.device = _DEVICES.get(got, got)
        self.note = "" if device != "auto" or self.device != "cpu" else _why_cpu(wanted)
        self._input = header.inputs[0].name
        self._outputs = [one.name for one in header.outputs]

    def run(self, pixels: NDArray[Any]) -> Arrays:
        """All outputs."""
        return dict(zip(self._outputs, self._session.run(self._outputs, {self._input: pixels}), strict=True))


def _session(runtime: Any, path: Path, options: Any, providers: list[str]) -> Any:
    """On the CPU where the others fail; ONNX Runtime would do that by itself, and print it where our output goes."""
    try:
        return runtime.InferenceSession(str(path), options, providers=providers, enable_fallback=0)
    except Exception:  # ONNX Runtime's own errors are no RuntimeErrors
        if len(providers) == 1:
            raise
    return runtime.InferenceSession(str(path), options, providers=[PROVIDERS["cpu"]], enable_fallback=0)


def _why_cpu(wanted: str) -> str:
    return "the GPU was listed, but the model did not get it" if wanted != "cpu" else "no GPU runtime is installed"


class _OpenCv:
    """OpenCV's own engine, which is there anyway; CPU only."""

    device = "cpu"
    batches = False
    note = "onnxruntime is not installed, so OpenCV runs the model; pip install 'sightline-robot[onnx]' is faster"

    def __init__(self, path: Path, header: OnnxHeader) -> None:
        import cv2

        self.name = f"OpenCV {cv2.__version__}"
        self._net = cv2.dnn.readNetFromONNX(str(path))
        self._input = header.inputs[0].name
        self._outputs = [one.name for one in header.outputs]

    def run(self, pixels: NDArray[Any]) -> Arrays:
        """All outputs."""
        self._net.setInput(np.ascontiguousarray(pixels), self._input)
        return dict(zip(self._outputs, self._net.forward(self._outputs), strict=True))
