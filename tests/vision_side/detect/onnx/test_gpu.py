"""The model that ships, on an NVIDIA GPU: it runs there, reports it, and finds what it finds on the CPU.

The tests skip without a GPU; `TESTS_DEMAND=cuda` makes that a failure. Needs onnxruntime-gpu in place of onnxruntime.
"""

import json

import pytest

from sightline.operator_side.cli import app as cli
from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.decode import DecodedImage, Decoder
from sightline.vision_side.detect.onnx.detector import SHIPPED
from sightline.vision_side.detect.onnx.engine import open_engine
from sightline.vision_side.detect.onnx.self_test import KEY, difference, golden_picture, read_golden
from sightline.vision_side.detect.onnx.tensors import fit_picture, model_format, read_outputs
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame
from sightline.vision_side.detect.registry import build_detector
from tests.fixtures import demanded
from tests.fixtures.vision.vision import camera, jpeg_of, scene

GPU = "cuda"
MODEL = camera()
JPEGS = [jpeg_of(golden_picture()), *(jpeg_of(scene(MODEL, far_m, aside, noise=0.0))
                                      for far_m, aside in ((0.6, 0.0), (1.0, 0.2), (1.5, -0.3), (2.2, 0.1)))]


def _eyes(device):
    return build_detector("onnx", {}, VisionConfig(detector=DetectorConfig(kind="onnx", device=device)))


@pytest.fixture(scope="module", autouse=True)
def on_gpu():
    """The detector on the GPU. Only this fixture checks for a GPU; opening the model runs the golden check on it."""
    try:
        return _eyes(GPU)
    except HardwareError as error:
        if not str(error).startswith(f"--device {GPU}"):  # it is there, and does not do what it should
            raise
        return demanded.do_without(GPU, str(error))


def _seen(eyes):
    decoder = Decoder(320, 240, 320 * 240)
    frames = [DetectFrame("r1", FrameHeader(session="0000abcd", seq=seq, t_us=seq * 33_333), jpeg, decoder)
              for seq, jpeg in enumerate(JPEGS)]
    return [eyes.detect([one], NO_DEADLINE)[0] for one in frames]


def test_every_result_names_its_device(on_gpu):
    assert [one.device for one in _seen(on_gpu)] == [GPU] * len(JPEGS) and on_gpu.notices() == []


def test_gpu_gives_the_detections_of_the_cpu(on_gpu):
    pairs = list(zip(_seen(on_gpu), _seen(_eyes("cpu")), strict=True))
    assert sum(len(there.detections) for _, there in pairs) >= 3, "there is something to see"
    for here, there in pairs:
        assert [one.label for one in here.detections] == [one.label for one in there.detections]
        for mine, other in zip(here.detections, there.detections, strict=True):
            edges = [(one.x1_px, one.y1_px, one.x2_px, one.y2_px) for one in (mine, other)]
            assert edges[0] == pytest.approx(edges[1], abs=1.0) and mine.score == pytest.approx(other.score, abs=0.02)


def test_gpu_gives_the_golden_output():
    engine = open_engine(SHIPPED, GPU, 1)
    form, picture = model_format(engine.header, (), "auto"), DecodedImage(golden_picture(), 1)
    pixels, fitting = fit_picture(picture, form)
    found = read_outputs(engine.run(pixels), form, fitting, picture, 0.5)
    assert found and difference(read_golden(engine.header.metadata[KEY]), found, 0.5) == ""


def test_auto_device_selects_the_gpu():
    assert {one.device for one in _seen(_eyes("auto"))} == {GPU}


def test_check_command_passes_on_the_gpu(capsys):
    code = cli.run(["detector", "check", "onnx", "--device", GPU, "--json"])
    told = json.loads(capsys.readouterr().out)
    assert code == 0 and told["ok"] and told["times"]
