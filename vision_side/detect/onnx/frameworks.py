"""The detectors `torch:FILE`, `torch:package.module:Class`, `ultralytics:FILE` and `transformers:FOLDER`. Shell.

Each opens an engine of another framework for the ONNX detector. No framework is a dependency. For a missing one, the
error has the command that installs it. A pickle can run any code when it is loaded, so it needs the option `pickle`.
"""

import importlib
import importlib.util
import json
import os
import pickle
import re
import sys
import zipfile
from collections.abc import Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sightline.protocol.config import PluginRegistry
from sightline.protocol.errors import ConfigError, HardwareError, SightlineError, home_path
from sightline.vision_side.detect.onnx.detector import DEFAULT_MIN_SCORE, LoadedModel, OnnxDetector, digest_of
from sightline.vision_side.detect.onnx.engine import Arrays, OnnxHeader, Tensor
from sightline.vision_side.detect.onnx.tensors import ModelFormat, model_format, named_labels, own_labels

if TYPE_CHECKING:
    from collections.abc import Iterator

_CLASSES: Final = PluginRegistry("model class", "sightline.torch_models")
_IS_CLASS: Final = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
_SIDE_PX: Final = 640
_Side = Annotated[int, Field(ge=1, le=8192)]  # 0 would mean an open dimension
_LONGEST: Final = 200
_RISK: Final = "may be a Python pickle, which can run any code on this machine when it is loaded"
_ULTRALYTICS: Final = {"YOLO_AUTOINSTALL": "false", "YOLO_OFFLINE": "true", "YOLO_VERBOSE": "false"}
"""Without these, the package downloads and installs by itself."""


class FrameworkDetector(OnnxDetector):
    """A detector whose model another package runs."""

    package: ClassVar[str] = ""
    """The required package, as pip and `import` name it."""
    license: ClassVar[str] = ""
    """The license of the package."""
    example: ClassVar[str] = "FILE"
    """An example address for the line that reports a missing address."""

    class Config(OnnxDetector.Config):
        """The options of `onnx`, and the permission to load a pickle."""

        pickle: bool = False
        """True to load a file that is a Python pickle. It can run any code, so use only files that you trust."""

    @classmethod
    def read_model(cls, config: Any) -> LoadedModel:
        """Load the model. Raises ConfigError for a missing package or file, an unfit model and a pickle."""
        if not config.address:
            raise ConfigError(f"detector {cls.kind!r} has no model: write e.g. {cls.kind}:{cls.example}")
        framework = cls.imported()
        with _one_line(config.address):
            return cls.opened(framework, config)

    @classmethod
    def imported(cls) -> Any:
        """Import the package. Raises ConfigError with the command that installs it."""
        try:
            return importlib.import_module(cls.package)
        except ImportError as error:
            broken = f"{cls.package} is installed and cannot be imported: {' '.join(str(error).split())}"
            raise ConfigError((cls.missing() or broken)[:_LONGEST]) from None

    @classmethod
    def missing(cls) -> str:
        """Return the line that reports the missing package; empty if it is installed."""
        if sys.modules.get(cls.package) is None and importlib.util.find_spec(cls.package) is None:
            return f"{cls.package} is not installed: pip install {cls.package} ({cls.license}; no part of Sightline)"
        return ""

    @classmethod
    def opened(cls, framework: Any, config: Any) -> LoadedModel:
        """Open the model that `config` names with the imported package."""
        raise NotImplementedError


@contextmanager
def _one_line(address: str) -> "Iterator[None]":
    """Turn any error of a framework into one line."""
    try:
        yield
    except SightlineError:
        raise
    except ValueError as error:
        raise ConfigError(f"model {address}: {' '.join(str(error).split())}"[:_LONGEST]) from None
    except Exception as error:  # frameworks raise their own classes for a bad file
        # TorchScript gives its own traceback first.
        text = " ".join(str(error).split()).rpartition("RuntimeError: ")[2]
        raise ConfigError(f"model {address} cannot be opened: {type(error).__name__}: {text}"[:_LONGEST]) from None


def _allowed_pickle(path: Path, config: Any) -> str:
    """Return the risk, for the operator. Raises ConfigError unless the configuration permits a pickle."""
    if not config.pickle:
        raise ConfigError(f"model {path} {_RISK}; export it to ONNX, or if you trust it, "
                          "--set detector.options.pickle=true (`detector check`: --set pickle=true)")
    return f"it {_RISK}"


def _device(torch: Any, wanted: str) -> str:
    """Return cpu or cuda. Raises HardwareError for a device that this package does not support."""
    has_cuda = bool(torch.cuda.is_available())
    if wanted == "tensorrt" or (wanted == "cuda" and not has_cuda):
        raise HardwareError(f"--device {wanted}: torch {torch.__version__} has no {wanted} here; try --device auto")
    return "cuda" if has_cuda and wanted != "cpu" else "cpu"


def _least(config: Any) -> float:
    return DEFAULT_MIN_SCORE if config.min_score is None else float(config.min_score)


def _loaded(path: Path, engine: Any, form: ModelFormat, config: Any, digest: str) -> LoadedModel:
    return LoadedModel(path, engine, form, _least(config), None, form, DEFAULT_MIN_SCORE, digest)


# --- PyTorch: TorchScript, a class, and with an option a pickle ----------------------------------------------------


class TorchDetector(FrameworkDetector):
    """A TorchScript file, or a class of `torch.nn.Module` by its import path."""

    kind = "torch"
    package = "torch"
    license = "BSD-3-Clause"
    example = "model.torchscript, or torch:my_model:Net"

    class Config(FrameworkDetector.Config):
        """The options of each framework, and facts that a PyTorch model does not contain."""

        size: Annotated[tuple[_Side, ...], Field(min_length=2, max_length=2)] | None = None
        """Rows and columns of the input; None: the size in a file of Ultralytics, or else 640x640."""
        weights: str = ""
        """For a class: the file of its `state_dict`, loaded without the code of a pickle."""

    @classmethod
    def opened(cls, framework: Any, config: Any) -> LoadedModel:
        """Open the file, or create the class, and run it once."""
        device = _device(framework, config.device)
        framework.set_num_threads(config.threads)
        if _IS_CLASS.fullmatch(config.address):
            path, metadata = Path(config.address), dict[str, Any]()
            digest = digest_of(home_path(config.weights)) if config.weights else ""
            module, note = _of_class(framework, config)
        else:
            path = home_path(config.address)
            digest = digest_of(path)
            module, metadata, note = _of_file(framework, path, config)
        rows, columns = config.size or metadata.get("imgsz") or (_SIDE_PX, _SIDE_PX)
        engine = _TorchEngine(framework, module.eval().to(device), device, note)
        header = engine.header(rows, columns, metadata)
        return _loaded(path, engine, model_format(header, config.names, config.color), config, digest)


def _of_class(torch: Any, config: Any) -> tuple[Any, str]:
    """Return a module of the class, and a note for the operator."""
    module, note = _CLASSES.load(config.address)(), ""
    if not isinstance(module, torch.nn.Module):
        raise ConfigError(f"model {config.address} is not a torch.nn.Module; name a class of one")
    if config.weights:
        path = home_path(config.weights)
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:  # it contains more than tensors
            note = _allowed_pickle(path, config)
            state = torch.load(path, map_location="cpu", weights_only=False)
        module.load_state_dict(state)
    return module, note


def _of_file(torch: Any, path: Path, config: Any) -> tuple[Any, dict[str, Any], str]:
    """Return the module of a file, its metadata, and a note for the operator."""
    with path.open("rb") as file:
        head = file.read(2)
    names = zipfile.ZipFile(path).namelist() if zipfile.is_zipfile(path) else []
    if any(name.endswith("/constants.pkl") for name in names):
        extra = {"config.txt": ""}  # metadata of Ultralytics
        return torch.jit.load(str(path), map_location="cpu", _extra_files=extra), _stated(extra["config.txt"]), ""
    if head == b"PK" and not names:
        raise ValueError("it is truncated; fetch the file again")
    if not any(name.endswith("/data.pkl") for name in names) and head[:1] != b"\x80":
        raise ValueError("it is not a TorchScript file; export it with torch.jit.trace, or to ONNX")
    note = _allowed_pickle(path, config)
    loaded = torch.load(path, map_location="cpu", weights_only=False)
    module = loaded.get("model") if isinstance(loaded, dict) else loaded
    if not isinstance(module, torch.nn.Module):
        raise ValueError("it has weights and no model; name the class: torch:package.module:Class with options.weights")
    return module.float(), {}, note


def _stated(text: str | bytes) -> dict[str, Any]:
    stated = json.loads(text or "{}")
    return stated if isinstance(stated, dict) else {}


class _TorchEngine:
    """Runs a module of PyTorch on float images (1, 3, H, W)."""

    def __init__(self, torch: Any, module: Any, device: str, note: str) -> None:
        self.name = f"torch {torch.__version__}"
        self.device = device
        self.note = note
        self._torch = torch
        self._module = module
        self._as_list = False

    def header(self, rows: int, columns: int, metadata: Mapping[str, Any]) -> OnnxHeader:
        """Run the module on an empty image, as a batch or as a list of images. Return its inputs and outputs."""
        pixels = np.zeros((1, 3, rows, columns), np.float32)
        try:
            outputs = self.run(pixels)
        except RuntimeError as error:
            if "List[Tensor]" not in str(error):
                raise
            self._as_list = True  # a script of torchvision
            outputs = self.run(pixels)
        names = metadata.get("names", {})
        table = {int(key): str(word) for key, word in names.items()} if isinstance(names, dict) else {}
        shapes = tuple(Tensor(name, "float32", tuple(one.shape)) for name, one in outputs.items())
        return OnnxHeader((Tensor("image", "float32", pixels.shape),), shapes, {"names": repr(table)} if table else {})

    def run(self, pixels: NDArray[Any]) -> Arrays:
        """Run the module on one image."""
        with self._torch.inference_mode():
            images = self._torch.from_numpy(pixels).to(self.device)
            return _arrays(self._module([images[0]] if self._as_list else images))


def _arrays(given: Any) -> Arrays:
    """Return the arrays of a module's answer: tensors, a table per image (torchvision), or the first output (YOLO)."""
    while isinstance(given, list | tuple) and given:
        tables = [one for one in given if isinstance(one, dict) and "boxes" in one]
        inner = [one for one in given if isinstance(one, list) and one and isinstance(one[0], dict)]
        if not (tables or inner):
            break
        given = tables[0] if tables else inner[0]
    if isinstance(given, dict):
        return {str(name): _array(one) for name, one in given.items() if hasattr(one, "detach")}
    tensors = [one for one in (given if isinstance(given, list | tuple) else [given]) if hasattr(one, "detach")]
    if not tensors:
        raise ValueError(f"it gives {type(given).__name__}; it should be tensors, or boxes, scores and labels")
    prototypes = [one for one in tensors[1:] if one.ndim == 4][:1]
    return {f"output{index}": _array(one) for index, one in enumerate((tensors[0], *prototypes))}


def _array(tensor: Any) -> NDArray[Any]:
    array: NDArray[Any] = tensor.detach().cpu().numpy()
    return array


# --- Ultralytics and Transformers: models from an image to boxes ---------------------------------------------------


class _ImageEngine:
    """Runs a function from an image (rows, columns, 3) to boxes, scores and labels."""

    def __init__(self, name: str, device: str, note: str, find: Any) -> None:
        self.name = name
        self.device = device
        self.note = note
        self._find = find

    def run(self, pixels: NDArray[Any]) -> Arrays:
        """Run the model on one image."""
        found: Arrays = self._find(pixels[0])
        return found


def _form(rgb: bool, labels: tuple[str, ...]) -> ModelFormat:
    return ModelFormat(floats=False, rgb=rgb, size=None, kind="triple", labels=labels)


class UltralyticsDetector(FrameworkDetector):
    """A file of Ultralytics: YOLO, RT-DETR. A round mask gives a circle."""

    kind = "ultralytics"
    package = "ultralytics"
    license = "AGPL-3.0"
    example = "yolo11n.pt"

    @classmethod
    def opened(cls, framework: Any, config: Any) -> LoadedModel:
        """Open the file without downloads."""
        path = home_path(config.address)
        digest = digest_of(path)
        # The package reads weights without these endings as pickles, or evaluates their text.
        note = "" if path.suffix in (".onnx", ".torchscript") else _allowed_pickle(path, config)
        device = _device(importlib.import_module("torch"), config.device)
        model, least = framework.YOLO(str(path)), _least(config)

        def find(bgr: NDArray[Any]) -> Arrays:
            (result,) = model.predict(bgr, conf=max(least, 0.001), device=device, verbose=False, retina_masks=True)
            boxes, masks = result.boxes, result.masks
            if boxes is None:
                raise ValueError("it gives no boxes; use a model for the task detect or segment")
            found = {"boxes": _array(boxes.xyxy), "scores": _array(boxes.conf), "labels": _array(boxes.cls)}
            return found if masks is None else {**found, "masks": _array(masks.data)}

        labels = named_labels(config.names) or own_labels({"names": repr(dict(model.names))})
        engine = _ImageEngine(f"ultralytics {framework.__version__}", device, note, find)
        return _loaded(path, engine, _form(False, labels), config, digest)

    @classmethod
    def imported(cls) -> Any:
        """Import the package with its installs and downloads disabled."""
        for name, value in _ULTRALYTICS.items():
            os.environ.setdefault(name, value)
        return super().imported()


class TransformersDetector(FrameworkDetector):
    """A folder of Transformers with an object detection model: DETR, RT-DETR, YOLOS and others."""

    kind = "transformers"
    package = "transformers"
    license = "Apache-2.0"
    example = "FOLDER"

    @classmethod
    def opened(cls, framework: Any, config: Any) -> LoadedModel:
        """Open the folder without downloads, and without running its code."""
        folder = home_path(config.address)
        files = sorted([*folder.glob("*.safetensors"), *folder.glob("*.bin")]) if folder.is_dir() else []
        digest = digest_of(folder / "config.json", *files)
        if not files:
            raise ValueError("it has no model.safetensors; save the model with save_pretrained")
        is_safe = any(one.suffix == ".safetensors" for one in files)
        note = "" if is_safe else _allowed_pickle(files[0], config)
        torch = importlib.import_module("torch")
        device = _device(torch, config.device)
        torch.set_num_threads(config.threads)
        only = {"local_files_only": True, "trust_remote_code": False}
        processor = framework.AutoImageProcessor.from_pretrained(folder, **only)
        model = framework.AutoModelForObjectDetection.from_pretrained(
            folder, **only, use_safetensors=is_safe).eval().to(device)
        least = _least(config)

        def find(rgb: NDArray[Any]) -> Arrays:
            with torch.inference_mode():
                outputs = model(**processor(images=rgb, return_tensors="pt").to(device))
            (found,) = processor.post_process_object_detection(outputs, threshold=least, target_sizes=[rgb.shape[:2]])
            return {name: _array(found[name]) for name in ("boxes", "scores", "labels")}

        words = model.config.id2label
        labels = named_labels(config.names) or own_labels({"names": repr({int(key): words[key] for key in words})})
        engine = _ImageEngine(f"transformers {framework.__version__}", device, note, find)
        return _loaded(folder, engine, _form(True, labels), config, digest)
