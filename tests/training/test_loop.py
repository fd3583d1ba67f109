"""Training itself, where PyTorch is: it learns, goes on after a cut, and its weights mean the same in ONNX."""

import errno
import hashlib
import multiprocessing
import os
from pathlib import Path

import numpy as np
import pytest

from tests.fixtures import demanded

demanded.module("torch", "train")
demanded.module("onnx", "dev")

import cv2
import onnx
import torch

from sightline.operator_side.cli import app as cli
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.sim.scenes.model import HEIGHT_PX, LABELS, SCORED_FROM, VALIDATED_FROM, WIDTH_PX, LabelledBox
from sightline.training import export as train_export
from sightline.training import loop as train_run
from sightline.training.export import onnx_bytes, weights_in
from sightline.training.loop import TorchNetwork, begin_from, blended, folded, train
from sightline.training.network import AGAINST, OUTPUTS, Layer, network
from sightline.training.scenes import CUT_PX, WHOLE_PX, DrawnScenes
from sightline.training.schedule import Training
from sightline.vision_side.detect.onnx.detector import SHIPPED
from tests.training.fixture import weights

pytestmark = pytest.mark.computes


def scenes(count=4):
    """Discs on grey: enough to learn from in a few steps."""
    pictures, truths = np.full((count, HEIGHT_PX, WIDTH_PX, 3), 90, np.uint8), []
    draw = np.random.default_rng(2)
    for picture in pictures:
        x, y = int(draw.integers(60, 260)), int(draw.integers(60, 180))
        cv2.circle(picture, (x, y), 20, (240, 200, 20), -1)
        truths.append((LabelledBox("ball", (x - 20.0, y - 20.0, x + 21.0, y + 21.0), 1.0),))
    return DrawnScenes(pictures, tuple(truths), ((),) * count, ((),) * count)


@pytest.mark.slow
def test_the_loss_falls(tmp_path):
    said = []
    train(scenes(), Training((100,), batch=2, rate=3e-3, seed=4), "cpu", tmp_path, said.append)
    losses = [float(line.rsplit(" ", 1)[1]) for line in said if "loss" in line]
    assert len(losses) == 2 and losses[-1] < 10


def test_interrupted_training_ends_with_the_same_result(tmp_path, monkeypatch):
    training = Training((2, 2), batch=2, seed=4)
    (tmp_path / "whole").mkdir()
    whole = train(scenes(), training, "cpu", tmp_path / "whole", lambda _: None)
    monkeypatch.setattr("sightline.training.loop._CHECKPOINT_EVERY", 2)
    cut = tmp_path / "cut"
    cut.mkdir()

    def fall(line):
        raise KeyboardInterrupt

    monkeypatch.setattr("sightline.training.loop._LOG_EVERY", 3)
    with pytest.raises(KeyboardInterrupt):
        train(scenes(), training, "cpu", cut, fall)
    monkeypatch.setattr("sightline.training.loop._LOG_EVERY", 100)
    said = []
    resumed = train(scenes(), training, "cpu", cut, said.append)
    assert said == ["continues at step 2 of 4"]
    assert all(np.array_equal(whole[name], resumed[name]) for name in whole)
    for others, again in ((scenes(), Training((5,), batch=2, seed=4)), (scenes(3), training)):
        with pytest.raises(ConfigError, match="other settings or scenes"):
            train(others, again, "cpu", cut, said.append)


def state_of(training):
    return train_run._State(scenes(), training, torch.device("cpu"))


@pytest.mark.parametrize("damage", [
    lambda content: b"", lambda content: content[: len(content) // 2], lambda content: content[:-30],
    lambda content: b"no checkpoint" * 9, lambda content: bytes(len(content)),
], ids=["empty", "half", "end", "text", "zeros"])  # fmt: skip
def test_damaged_checkpoint_is_one_line(damage, tmp_path):
    training, path = Training((1,), batch=2, seed=4), tmp_path / train_run.CHECKPOINT
    state_of(training).save(path, 1)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ConfigError, match=r"checkpoint .* cannot be read \(.*\); remove it") as told:
        train(scenes(), training, "cpu", tmp_path, lambda _: None)
    assert "\n" not in str(told.value)


def test_full_disk_leaves_the_checkpoint_before(tmp_path, monkeypatch):
    def full(_file):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    training, path = Training((4,), batch=2, seed=4), tmp_path / train_run.CHECKPOINT
    state = state_of(training)
    state.save(path, 2)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        state.save(path, 4)
    assert state.load(path) == 2 and list(tmp_path.iterdir()) == [path]


def test_processes_that_feed_a_gpu_prepare_the_same_batches():
    training = Training((1, 1, 4), batch=4, seed=2)
    plain = list(train_run._batches(scenes(), training, 1))
    fed = list(train_run._fed(scenes(), training, 1, 2))
    assert len(plain) == len(fed) == 5
    assert all(np.array_equal(one, other.numpy()) for first, second in zip(plain, fed, strict=True)
               for one, other in zip(first, second, strict=True))
    assert not multiprocessing.active_children()


def test_a_label_that_is_not_known_is_not_learned():
    """A photograph may show legs without a label: whatever the network answers there changes no loss."""
    draw = torch.Generator().manual_seed(1)
    batch = next(train_run._batches(scenes(), Training((1,), batch=2, seed=2), 0))
    given = torch.randn((*batch.heat.shape[:1], OUTPUTS + 1, *batch.heat.shape[2:]), generator=draw)
    known = np.array([[1, 0, 0, 0, 0, 1]] * len(batch.known), np.float32)
    other = given.clone()
    other[:, 1 : len(LABELS)] += 3.0

    def loss(answer, some):
        return float(train_run._loss(answer, some, torch.as_tensor))

    assert loss(given, batch._replace(known=known)) == loss(other, batch._replace(known=known))
    assert loss(given, batch) != loss(other, batch)


@pytest.mark.slow
def test_two_processes_train_one_network(tmp_path, capfd):
    """The second's share counts: the same first half alone ends elsewhere; and a cut is gone on from."""
    made = []
    for jobs, batch, steps in ((2, 4, 2), (2, 4, 2), (1, 2, 2)):
        folder = tmp_path / str(len(made))
        folder.mkdir()
        made.append(train(scenes(), Training((steps,), batch, seed=4, jobs=jobs), "cpu", folder, lambda _: None))
    first, again, half = made
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert any(not np.allclose(first[name], half[name], atol=1e-4) for name in first)
    with pytest.raises(ConfigError, match="other settings"):
        train(scenes(), Training((3,), 4, seed=4, jobs=2), "cpu", tmp_path / "0", lambda _: None)
    assert "Traceback" not in capfd.readouterr().err
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_a_process_that_dies_is_one_line(tmp_path):
    def kill(line):
        for one in multiprocessing.active_children():
            one.kill()

    with pytest.raises(HardwareError, match="one of the 2 training processes ended") as told:
        train(scenes(), Training((200,), 4, seed=4, jobs=2), "cpu", tmp_path, kill)
    assert "\n" not in str(told.value) and "--jobs 1" in str(told.value)
    assert not multiprocessing.active_children()


def test_graph_and_module_give_equal_outputs(tmp_path):
    torch.manual_seed(3)
    network = TorchNetwork()
    with torch.no_grad():
        network.layer_head.weight.normal_(0, 0.3)
        network.layer_head.bias.zero_()
        for _ in range(3):  # so that the normalisation has something to fold in
            network(torch.randint(0, 256, (2, 3, HEIGHT_PX, WIDTH_PX), dtype=torch.uint8))
    network.eval()
    image = np.random.default_rng(4).integers(0, 256, (1, *WHOLE_PX[::-1], 3), dtype=np.uint8)
    with torch.no_grad():
        heat = network(torch.from_numpy(image).permute(0, 3, 1, 2))[0]
        heat[0] -= AGAINST * heat[OUTPUTS]  # what looks like something else looks less like a ball
        heat = torch.sigmoid(heat[: len(LABELS)])
    path = tmp_path / "model.onnx"
    path.write_bytes(onnx_bytes(folded(network.state_dict()), {}))
    net = cv2.dnn.readNetFromONNX(str(path))
    net.setInput(image, "image")
    scores = net.forward(["boxes", "scores", "labels"])[1].reshape(-1)
    assert scores.max() == pytest.approx(float(heat.max()), abs=1e-3)


def test_network_started_from_a_file_gives_the_outputs_of_the_file():
    network, given = TorchNetwork(), weights()
    images = torch.randint(0, 256, (4, 3, HEIGHT_PX, WIDTH_PX), dtype=torch.uint8)
    begin_from(network, weights_in(onnx_bytes(given, {})), images)
    assert network.training and np.allclose(network.layer_head.bias[:OUTPUTS].detach(), given["head.bias"])
    again = folded(network.state_dict())
    for name, value in given.items():
        if not name.startswith("head."):  # whose first row has what it learned of other things taken off
            assert again[name] == pytest.approx(value, abs=1e-4), name
    with torch.no_grad():
        seen_by_batch = network(images)
        seen_by_itself = network.eval()(images)
    assert seen_by_batch == pytest.approx(seen_by_itself, abs=1e-2), "the normalisation knows what it will see"


def test_a_larger_networks_file_gives_the_layers_that_are_left(monkeypatch):
    given, draw = weights(), np.random.default_rng(5)
    larger = [*network()[:-1], Layer("more", "conv", ("top",), 32), network()[-1]]
    more = {"more.weight": draw.normal(size=(32, 32, 1, 1)), "more.bias": draw.normal(size=32)}
    with monkeypatch.context() as patched:
        patched.setattr(train_export, "network", lambda: tuple(larger))
        content = onnx_bytes({**given, **more}, {})
    left = weights_in(content)
    assert set(left) == set(given) and all(np.array_equal(left[name], value) for name, value in given.items())


def test_a_training_from_a_model_ends_with_a_share_of_its_weights():
    start = {"a": np.float32([[1.0, 2.0]]), "b": np.float32([8.0])}
    ended = blended(start, {"a": np.float32([[3.0, -2.0]]), "b": np.float32([8.0])})
    assert ended["a"] == pytest.approx(np.array([[2.6, -1.2]])) and ended["b"] == pytest.approx(8.0)
    assert {one.dtype for one in ended.values()} == {np.dtype(np.float32)}


@pytest.mark.slow
def test_the_last_round_alone_is_trained_from_a_file(tmp_path, capsys):
    sizes = {"scenes": 8, "batch": 4, "jobs": 1, "validated": 5, "judged": 5}
    arguments = [part for name, value in sizes.items() for part in (f"--{name}", str(value))]
    model, digest = SHIPPED, hashlib.sha256(SHIPPED.read_bytes()).hexdigest()
    command = ["train", "--out", str(tmp_path), *arguments, "--steps", "70", "--steps", "2", "--start", str(model)]
    assert cli.run(command) == 0
    assert capsys.readouterr().out.startswith("continues at step 70 of 72\n")
    card = (tmp_path / "sightline.md").read_text("utf-8")
    assert "--jobs 1 --validated 5 --start MODEL`" in card and f"began from MODEL, of SHA-256 `{digest}`" in card
    begun, ended = (weights_in(one.read_bytes()) for one in (model, tmp_path / "sightline.onnx"))
    assert begun["half.weight"] == pytest.approx(ended["half.weight"], rel=0.2, abs=0.02)
    assert not np.array_equal(begun["half.weight"], ended["half.weight"])
    assert cli.run([*command[:-2]]) == 2
    assert "other settings" in capsys.readouterr().err


@pytest.mark.parametrize("content", [None, b"", b"no model", "other", "not finite"])
def test_start_from_another_network_gives_one_error_line(content, tmp_path, capsys):
    path = tmp_path / "begin.onnx"
    if content == "other":
        content = onnx.ModelProto(graph=onnx.GraphProto(name="another")).SerializeToString()
    if content == "not finite":
        content = onnx_bytes({**weights(), "eighth.bias": np.full(64, np.nan, np.float32)}, {})
    if content is not None:
        path.write_bytes(content)
    little = ["--scenes", "8", "--steps", "1", "--jobs", "1", "--validated", "5", "--judged", "5"]  # should it be taken
    assert cli.run(["train", "--out", str(tmp_path / "out"), *little, "--start", str(path)]) == 2
    error = capsys.readouterr().err.strip()
    assert f"--start {path}" in error and "\n" not in error and not (tmp_path / "out").exists()


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, lambda path: path.symlink_to("/dev/zero")])
def test_start_from_a_pipe_device_or_folder_gives_one_error_line(make, tmp_path, capsys):
    """A pipe without a writer would block the command; a device without an end would fill the memory."""
    make(tmp_path / "begin")
    assert cli.run(["train", "--out", str(tmp_path / "out"), "--start", str(tmp_path / "begin")]) == 2
    error = capsys.readouterr().err
    assert f"--start {tmp_path / 'begin'} is not a regular file; name a model from `sightline train`\n" in error


@pytest.mark.parametrize("content", [b"", onnx.ModelProto(graph=onnx.GraphProto(name="bare")).SerializeToString()])
def test_weights_of_a_file_without_nodes_are_not_looked_for(content):
    with pytest.raises(ValueError, match="it is not an ONNX model, or an empty one"):
        weights_in(content)


def test_a_gpu_takes_each_batch_whole(tmp_path, monkeypatch):
    """Also for a training that starts from a file, which its checkpoint names."""
    asked = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(train_run, "run_training", lambda options, *_: asked.append(options) or tmp_path / "m.onnx")
    for device, jobs in (("cuda", 1), ("cpu", 4)):
        assert cli.run(["train", "--out", str(tmp_path), "--device", device, "--jobs", "4"]) == 0
        assert (asked[-1].training.jobs, asked[-1].jobs) == (jobs, 4)


def test_thresholds_are_not_chosen_on_scenes_for_scores(tmp_path, capsys):
    assert cli.run(["train", "--out", str(tmp_path), "--validated", str(SCORED_FROM - VALIDATED_FROM + 1)]) == 2
    assert "--validated" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_cut_outs_halve_as_evenly_as_pictures():
    assert all(side % 16 == 0 for side in CUT_PX)


@pytest.mark.slow
def test_the_whole_command_ends_with_a_model_and_its_card(tmp_path, capsys):
    sizes = {"scenes": 8, "steps": 2, "batch": 4, "jobs": 1, "validated": 5, "judged": 5}
    arguments = [part for name, value in sizes.items() for part in (f"--{name}", str(value))]
    assert cli.run(["train", "--out", str(tmp_path), *arguments, "--steps", "1"]) == 0
    told = capsys.readouterr().out.splitlines()
    assert str(tmp_path / "sightline.onnx") in told[-1] and len(told) <= 4
    card = (tmp_path / "sightline.md").read_text("utf-8")
    assert "--scenes 8 --steps 2 --steps 1 --rate 0.003 --batch 4 --seed 1 --device cpu --jobs 1" in card
    assert hashlib.sha256((tmp_path / "sightline.onnx").read_bytes()).hexdigest() in card
