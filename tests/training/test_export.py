"""Training without PyTorch: the network's table, what is learned from a scene, and the ONNX graph."""

import errno
import json
import os
import pickle
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

import cv2

from sightline.evaluation.photographs import FEWEST, SHIPPED, read_photographs
from sightline.operator_side.cli import app as cli
from sightline.protocol.errors import ConfigError
from sightline.sim.scenes.model import HARDER, HEIGHT_PX, LABELS, WIDTH_PX, LabelledBox, PhotoScene
from sightline.sim.scenes.photos import photo_scene
from sightline.sim.scenes.render import SceneRenderer
from sightline.training import scenes as module
from sightline.training.network import GEOMETRY, OUTPUTS, SIZE_PX, STRIDE, network
from sightline.training.scenes import (
    CUT_PX,
    WHOLE_PX,
    DrawnScenes,
    SceneSource,
    _photographs,
    drawn_scenes,
    open_miner,
    sample,
    with_false_balls,
)
from sightline.training.schedule import SceneRange, Training
from tests.fixtures.vision.onnx import brightness_model
from tests.training.fixture import weights

pytestmark = pytest.mark.computes

BALL = LabelledBox("ball", (100.0, 60.0, 141.0, 99.0), 1.0)


def one_scene(truths=(BALL,), unclear=(), others=()):
    picture = np.full((1, HEIGHT_PX, WIDTH_PX, 3), 120, np.uint8)
    return DrawnScenes(picture, (tuple(truths),), (tuple(unclear),), (tuple(others),))


def shown(scenes, seed, step, place, size_px):
    """Any of all scenes."""
    return sample(scenes, SceneRange(0, len(scenes.truths)), (seed, step, place), size_px)


def test_the_table_is_a_network_of_the_agreed_size():
    sizes = {"image": WHOLE_PX[::-1]}
    for layer in network():
        rows, columns = sizes[layer.takes[0]]
        assert rows % layer.stride == 0 and columns % layer.stride == 0, "halves evenly"
        sizes[layer.name] = (rows // layer.stride, columns // layer.stride)
        if layer.kind == "add-up":
            assert sizes[layer.takes[0]] == tuple(2 * side for side in sizes[layer.takes[1]])
    assert sizes["head"] == (WHOLE_PX[1] // STRIDE, WHOLE_PX[0] // STRIDE)
    assert network()[-1].channels == OUTPUTS == len(LABELS) + GEOMETRY
    assert 100_000 <= sum(one.size for one in weights().values()) <= 180_000


def decoded(one, row, column):
    """The box that the geometry of a cell means."""
    off_x, off_y, wide, high = one.geometry[:, row, column]
    x, y = (column + 0.5 + off_x) * STRIDE, (row + 0.5 + off_y) * STRIDE
    half_wide, half_high = np.exp(wide) * SIZE_PX / 2, np.exp(high) * SIZE_PX / 2
    return x - half_wide, y - half_high, x + half_wide, y + half_high


def test_the_cells_about_an_objects_middle_learn_its_box():
    ones, mirrored = 0, 0
    enlarged = WHOLE_PX[0] / WIDTH_PX
    mirror_image = (WIDTH_PX - 141, 60, WIDTH_PX - 100, 99)
    own, other_side = ([enlarged * edge for edge in box] for box in (BALL.box, mirror_image))
    row = int((own[1] + own[3]) / 2 // STRIDE)
    for place in range(20):
        one = shown(one_scene(), 7, 0, place, WHOLE_PX)
        assert one.image.shape == (3, *WHOLE_PX[::-1]) and one.image.dtype == np.uint8
        box = own if one.heat[0, row, int((own[0] + own[2]) / 2 // STRIDE)] == 1.0 else other_side
        mirrored += box is other_side
        assert np.argwhere(one.heat == 1.0).tolist() == [[0, row, int((box[0] + box[2]) / 2 // STRIDE)]]
        for cell in np.argwhere(one.sure > 0):
            assert decoded(one, *cell) == pytest.approx(box, abs=1e-3)
            ones += 1
        assert one.counts.min() == 1.0
    assert ones >= 3 * 20 and 4 <= mirrored <= 16


def test_the_same_numbers_give_the_same_sample():
    first, again = (shown(one_scene(), 3, 11, 2, CUT_PX) for _ in range(2))
    assert np.array_equal(first.image, again.image) and np.array_equal(first.heat, again.heat)
    assert first.image.shape == (3, CUT_PX[1], CUT_PX[0])
    assert not np.array_equal(first.image, shown(one_scene(), 3, 12, 2, CUT_PX).image)


def four_scenes():
    """Detections with separate labels, which identify the input."""
    pictures = np.full((4, HEIGHT_PX, WIDTH_PX, 3), 120, np.uint8)
    return DrawnScenes(pictures, tuple((LabelledBox(label, BALL.box, 1.0),) for label in LABELS[:4]), ((),) * 4,
                       (((4.0, 180.0, 44.0, 220.0),),) * 4)


def times_shown(which, count):
    """Count each of the four."""
    heats = [sample(four_scenes(), which, (1, 0, place), WHOLE_PX).heat for place in range(count)]
    return np.bincount([int(np.argwhere(heat[: len(LABELS)] == 1.0)[0, 0]) for heat in heats], minlength=4).tolist()


def test_only_the_scenes_that_are_known_by_then_are_shown():
    for known in (1, 3, 4):
        assert {place for place, times in enumerate(times_shown(SceneRange(0, known), 60)) if times} == {*range(known)}


def test_a_round_of_harder_pictures_shows_its_own_scenes_more_often():
    assert min(times_shown(SceneRange(3, 4), 200)) > 30
    times = times_shown(SceneRange(3, 4, harder=True), 200)
    assert min(times) > 10 and 95 < times[3] < 155


def test_a_round_of_harder_pictures_is_cut_around_other_things_too():
    def middle_in_view(which):
        seen = [sample(four_scenes(), which, (1, 0, place), CUT_PX).heat[-1].max() == 1.0 for place in range(200)]
        return sum(seen)

    assert middle_in_view(SceneRange(0, 4, harder=True)) > middle_in_view(SceneRange(0, 4)) + 20


def test_a_round_of_harder_pictures_has_more_clear_ones_and_more_bad_ones():
    """Images of black and white squares: clear ones are bright with sharp edges, bad ones neither."""
    squares = (np.indices((HEIGHT_PX, WIDTH_PX)) // 40).sum(0) % 2 * 255
    scenes = DrawnScenes(np.repeat(squares[None, ..., None], 3, 3).astype(np.uint8), ((),), ((),), ((),))

    def kinds(which):
        pictures = [sample(scenes, which, (1, 0, place), WHOLE_PX).image.astype(int) for place in range(150)]
        sharp = [np.abs(np.diff(one.mean(0))).max() > 60 * WIDTH_PX / WHOLE_PX[0] for one in pictures]
        bright = [one.mean() > 100 for one in pictures]
        both = list(zip(sharp, bright, strict=True))
        return both.count((True, True)), both.count((False, False))

    clear, bad = kinds(SceneRange(0, 1, harder=True))
    clear_before, bad_before = kinds(SceneRange(0, 1))
    assert clear > clear_before + 10 and bad > bad_before + 10


def test_object_mostly_outside_the_cut_is_ignored():
    blanked = marked = 0
    for place in range(60):
        one = shown(one_scene(), 5, 0, place, CUT_PX)
        has_middle = bool((one.heat == 1.0).any())
        marked += has_middle
        blanked += not has_middle and one.counts.min() == 0
        assert has_middle == bool(one.sure.any())
    assert marked > 20 and blanked > 0


def test_unclear_objects_are_not_learned():
    one = shown(one_scene((), [(40.0, 40.0, 80.0, 80.0)]), 5, 0, 1, WHOLE_PX)
    assert not one.heat.any() and 130 < np.count_nonzero(one.counts == 0) < 220


def test_unlabeled_objects_have_a_separate_map():
    box = (40.0, 60.0, 90.0, 100.0)
    alone, beside = (shown(one_scene(truths, (), [box]), 5, 0, 1, WHOLE_PX) for truths in ((), (BALL,)))
    assert np.unique(np.argwhere(alone.heat > 0)[:, 0]).tolist() == [len(LABELS)] and (alone.heat[-1] == 1).sum() == 1
    assert not alone.sure.any() and not alone.geometry.any(), "where its edges are is not learned"
    assert any(np.allclose(beside.heat[-1], one) for one in (alone.heat[-1], alone.heat[-1][:, ::-1])), "or mirrored"
    assert np.array_equal(beside.geometry, shown(one_scene(), 5, 0, 1, WHOLE_PX).geometry)


def test_each_label_has_a_separate_map():
    for number, label in enumerate(LABELS):
        one = shown(one_scene((LabelledBox(label, (40.0, 60.0, 90.0, 200.0), 1.0),)), 5, 0, 1, WHOLE_PX)
        assert np.unique(np.argwhere(one.heat > 0)[:, 0]).tolist() == [number]


def test_scenes_are_drawn_once(tmp_path):
    told = []
    first = drawn_scenes(tmp_path, SceneSource(8), 1, told.append)
    stamp = (tmp_path / "scenes.npy").stat().st_mtime_ns
    again = drawn_scenes(tmp_path, SceneSource(8), 1, told.append)
    assert (tmp_path / "scenes.npy").stat().st_mtime_ns == stamp and told == [8, 8]
    sent = pickle.loads(pickle.dumps(again))  # as to the processes that train
    assert len(pickle.dumps(again)) < 20_000 and np.array_equal(sent.pictures, again.pictures)
    assert first.truths == again.truths == sent.truths and first.others == sent.others and any(first.others)
    assert first.pictures.shape == (8, HEIGHT_PX, WIDTH_PX, 3)
    assert all(picture.std() > 1 for picture in first.pictures) and any(first.truths)


@pytest.mark.slow
def test_scenes_are_drawn_again_when_they_would_be_others_now_or_were_cut(tmp_path, monkeypatch):
    first = drawn_scenes(tmp_path, SceneSource(3), 1, lambda _: None)
    (tmp_path / "scenes.json").unlink()  # as a run leaves it that is cut while it draws
    again = drawn_scenes(tmp_path, SceneSource(3), 1, lambda _: None)
    assert np.array_equal(first.pictures, again.pictures) and first.digest() == again.digest()
    notes = tmp_path / "scenes.json"
    stamp = notes.stat().st_mtime_ns
    pictures = np.lib.format.open_memmap(tmp_path / "scenes.npy", "r+")
    pictures[1] += 1  # as if they were drawn by an older program
    pictures.flush()
    assert drawn_scenes(tmp_path, SceneSource(3), 1, lambda _: None).truths == first.truths
    assert notes.stat().st_mtime_ns > stamp
    assert drawn_scenes(tmp_path, SceneSource(2), 1, lambda _: None).digest() != first.digest()


def test_no_scene_of_another_purpose_is_trained_on(tmp_path):
    for source in (SceneSource(800_001), SceneSource(200_001, every=4)):
        with pytest.raises(ConfigError, match=f"--scenes {source.count}: 1 to {800_000 // source.every}"):
            drawn_scenes(tmp_path, source, 1, lambda _: None)


@pytest.mark.parametrize("every", [3, 6])
def test_scenes_of_one_color_of_lights_are_rejected(tmp_path, every):
    with pytest.raises(ConfigError, match=f"--every {every}: all traffic lights .* that 3 does not divide"):
        drawn_scenes(tmp_path, SceneSource(9, every=every), 1, lambda _: None)


@pytest.fixture
def photographs(tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    for seed in range(FEWEST):
        coarse = np.random.default_rng(seed).integers(0, 255, (5, 7, 3), np.uint8)
        cv2.imwrite(str(folder / f"{seed:02}.jpg"), cv2.resize(coarse, (WIDTH_PX + seed, HEIGHT_PX)))
    return folder


def test_scenes_over_photographs_are_half_of_what_is_shown(tmp_path, photographs):
    drawn = drawn_scenes(tmp_path, SceneSource(2, 3, photographs, every=75_001), 1, lambda _: None)
    assert drawn.own == 2 and len(drawn.truths) == 5
    with SceneRenderer() as renderer:
        assert np.array_equal(drawn.pictures[1], renderer.scene(75_001, HARDER).rgb)
    pictures = [one.rgb for one in read_photographs(photographs)]
    assert np.array_equal(drawn.pictures[3], photo_scene(pictures, 1).rgb)
    shown_at = Training((1, 1, 10)).shown_at(5, drawn.own)
    samples = [sample(drawn, shown_at, (1, 5, place), CUT_PX) for place in range(80)]
    over_photos = [one for one in samples if not one.known.all()]
    assert 25 < len(over_photos) < 55
    assert all(one.known.tolist() == [1, 0, 0, 0, 0, 1] for one in over_photos)  # balls and other things only


def test_a_quarter_of_what_is_over_photographs_is_as_large_as_in_a_second_look(monkeypatch):
    picture = np.full((2, HEIGHT_PX, WIDTH_PX, 3), 40, np.uint8)
    picture[:, 100:120, 150:170] = 220
    ball = LabelledBox("ball", (150.0, 100.0, 170.0, 120.0), 1.0)
    scenes = DrawnScenes(picture, ((), (ball,)), ((), ()), ((), ()), 1)
    cuts, cut = [], module._cut
    monkeypatch.setattr(module, "_cut", lambda draw, boxes, size_px: cuts.append(size_px) or cut(draw, boxes, size_px))
    over_photos, whole = [], 0
    for one in (sample(scenes, SceneRange(0, 1), (4, 0, place), CUT_PX) for place in range(400)):
        over_photos += [cuts[-1]] * (not one.known.all())
        for _, row, column in np.argwhere(one.heat[:1] == 1.0):
            left, top, right, bottom = (round(edge) for edge in decoded(one, row, column))
            if left < 8 or top < 1 or right > CUT_PX[0] - 1 or bottom > CUT_PX[1] - 1:
                continue
            assert (right - left) / 20 == CUT_PX[0] / cuts[-1][0]
            inside, beside = (one.image[:, top:bottom, first:last].mean() for first, last in ((left, right), (0, left)))
            assert inside > beside + 15, "the box is where the picture has it"
            whole += 1
    assert whole > 60 and set(over_photos) == {(160, 120), (96, 72)} and set(cuts) == set(over_photos)
    assert 0.15 < over_photos.count((96, 72)) / len(over_photos) < 0.35


def test_false_balls_of_a_model_become_other_things():
    ball, other, hidden = (10.0, 10.0, 50.0, 50.0), (200.0, 100.0, 240.0, 140.0), (100.0, 150.0, 140.0, 190.0)
    rgb = np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    rgb[..., 0] = 200
    scene = PhotoScene(rgb, (LabelledBox("ball", ball, 1.0),), (other,), (hidden,))
    false = (280.0, 20.0, 300.0, 40.0)
    shown = []

    def miner(bgr):
        shown.append(bgr[0, 0].tolist())
        return [(12.0, 9.0, 52.0, 49.0), false, (105.0, 155.0, 150.0, 190.0)]

    more = with_false_balls(scene, miner)
    assert more.others == (other, false), "detections of labeled and of hidden balls are left out"
    assert more.truths == scene.truths and shown == [[0, 0, 200]]


def test_a_model_finds_its_own_balls_for_mining(tmp_path):
    picture = np.full((HEIGHT_PX, WIDTH_PX, 3), 128, np.uint8)
    path = brightness_model(tmp_path / "m.onnx", [[10.0, 20.0, 60.0, 90.0], [100.0, 20.0, 160.0, 90.0]], [0, 1])
    assert open_miner(path)(picture) == [(10.0, 20.0, 60.0, 90.0)]  # the second has another label


def test_a_photograph_that_scores_detectors_is_not_trained_on(tmp_path, photographs):
    for one in sorted(SHIPPED.glob("*.jpg"))[:2]:
        cv2.imwrite(str(photographs / f"mine-{one.stem}.png"), cv2.resize(cv2.imread(str(one)), (640, 480)))
    with pytest.raises(ConfigError, match=r"mine-\S+ shows the same as \S+, which is for scores only.* and 1 more"):
        drawn_scenes(tmp_path, SceneSource(2, 8, photographs), 1, lambda _: None)


@pytest.fixture
def no_simulator(monkeypatch):
    """Gray images in place of the simulator's, drawn by a thread."""
    gray = PhotoScene(np.full((HEIGHT_PX, WIDTH_PX, 3), 120, np.uint8), (), (), ())
    monkeypatch.setattr(module, "SceneRenderer", lambda: nullcontext(SimpleNamespace(scene=lambda *_: gray)))
    monkeypatch.setattr(module, "worker_pool", ThreadPoolExecutor)


@pytest.mark.usefixtures("no_simulator")
def test_scenes_are_drawn_again_for_other_notes_or_another_miner(tmp_path, photographs):
    miners = [brightness_model(tmp_path / f"{word}.onnx", [[10.0, 20.0, 60.0, 90.0]], [0], words=(word,))
              for word in ("cup", "hat")]  # neither finds a ball
    sources = [SceneSource(1, 2, photographs, mined_with=one) for one in miners]
    notes, drawn = tmp_path / "scenes.json", tmp_path / "scenes.npy"
    first = drawn_scenes(tmp_path, sources[0], 1, lambda _: None)
    stamps = [drawn.stat().st_mtime_ns]
    rows = json.loads(notes.read_text())
    rows[2]["others"] = [[1.0, 2.0, 3.0, 4.0]]
    notes.write_text(json.dumps(rows))
    for source in (sources[0], sources[1], sources[1]):
        again = drawn_scenes(tmp_path, source, 1, lambda _: None)
        stamps.append(drawn.stat().st_mtime_ns)
        assert again.others == first.others
    assert stamps[0] < stamps[1] < stamps[2] == stamps[3]


@pytest.mark.usefixtures("no_simulator")
def test_scenes_are_drawn_again_for_one_other_photograph_of_many(tmp_path, photographs, monkeypatch):
    """Whichever it is: two scenes show at most two of them."""
    monkeypatch.setattr(module, "_check_photographs", lambda _folder: None)

    def stamp():
        for cached in (_photographs, module._photographs_digest):
            cached.cache_clear()
        scenes = drawn_scenes(tmp_path, SceneSource(1, 2, photographs), 1, lambda _: None)
        assert pickle.loads(pickle.dumps(scenes)).digest() == scenes.digest()
        return (tmp_path / "scenes.npy").stat().st_mtime_ns, scenes.digest()

    stamps = [stamp()]
    for name in ("03.jpg", "07.jpg", "11.jpg"):  # one of them is in neither scene
        cv2.imwrite(str(photographs / name), 255 - cv2.imread(str(photographs / name)))
        stamps.append(stamp())
    assert [len({*each}) for each in zip(*stamps, strict=True)] == [4, 4] and stamp() == stamps[-1]


@pytest.mark.usefixtures("no_simulator")
@pytest.mark.parametrize("name", ["scenes.npy", "scenes.json"])
@pytest.mark.parametrize("share", [0.0, 0.001, 0.6])
def test_damaged_scenes_are_drawn_again(name, share, tmp_path):
    def draw():
        return drawn_scenes(tmp_path, SceneSource(3), 1, lambda _: None)

    first = draw().pictures.copy()
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(share * len(content))])
    assert np.array_equal(draw().pictures, first) and (tmp_path / name).read_bytes() == content


@pytest.mark.usefixtures("no_simulator")
def test_scenes_that_do_not_fit_on_the_disk_are_one_line(tmp_path, monkeypatch, capsys):
    def full(_file, first, count):
        assert first == 0 and count > 8 * HEIGHT_PX * WIDTH_PX * 3
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    demanded.module("torch", "train")
    monkeypatch.setattr(os, "posix_fallocate", full)
    little = ["--scenes", "8", "--steps", "1", "--jobs", "1", "--validated", "5", "--scored", "5"]  # should it go on
    assert cli.run(["train", "--out", str(tmp_path), *little]) == 2
    error = capsys.readouterr().err.strip()
    assert error == f"error: --out {tmp_path}: No space left on device; free some space or name another folder"
    assert not list(tmp_path.iterdir())


def test_digest_of_scenes_covers_all_boxes():
    boxes = [(40.0, 40.0, 80.0, 80.0)]
    scenes = [one_scene(), one_scene((BALL,), boxes), one_scene((BALL,), (), boxes)]
    assert len({one.digest() for one in scenes}) == 3


@pytest.mark.slow
def test_scenes_are_drawn_again_for_other_photographs(tmp_path, photographs):
    source = SceneSource(1, 2, photographs)
    first = drawn_scenes(tmp_path, source, 1, lambda _: None).pictures.copy()
    for one in photographs.iterdir():
        cv2.imwrite(str(one), 255 - cv2.imread(str(one)))
    _photographs.cache_clear()
    again = drawn_scenes(tmp_path, source, 1, lambda _: None)
    assert np.array_equal(first[0], again.pictures[0]) and not np.array_equal(first[1:], again.pictures[1:])


def test_training_without_pytorch_prints_the_install_command(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "torch", None)
    assert cli.run(["train", "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert "pip install --editable '.[train]'" in error and "torch" in error and "\n" not in error


@pytest.mark.parametrize("arguments", [["--steps", "0"], ["--device", "tpu"], ["--scenes", "3"], ["--batch", "1"]])
def test_a_bad_option_is_one_line(arguments, capsys):
    assert cli.run(["train", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert arguments[0] in error and "\n" not in error


class TestGraph:
    """The ONNX file, by weights that mean nothing."""

    @pytest.fixture(scope="class")
    @classmethod
    def made(cls, tmp_path_factory):
        demanded.module("onnx", "dev")
        from sightline.training.export import onnx_bytes

        path = tmp_path_factory.mktemp("model") / "random.onnx"
        path.write_bytes(onnx_bytes(weights(), {"min_score": "0.5"}))
        return path

    def outputs(self, path, image):
        net = cv2.dnn.readNetFromONNX(str(path))
        net.setInput(image, "image")
        names = ["boxes", "scores", "labels"]
        found = dict(zip(names, net.forward(names), strict=True))
        return found["boxes"].reshape(-1, 4), found["scores"].reshape(-1), found["labels"].reshape(-1)

    def picture(self, seed=3):
        return np.random.default_rng(seed).integers(0, 256, (1, *WHOLE_PX[::-1], 3), dtype=np.uint8)

    def test_the_file_is_opset_17_and_reports_what_it_finds(self, made):
        import onnx

        model = onnx.load(made)
        assert [one.version for one in model.opset_import] == [17]
        properties = {one.key: one.value for one in model.metadata_props}
        assert json.loads(properties["labels"]) == list(LABELS) and properties["min_score"] == "0.5"
        assert made.stat().st_size < 1_000_000

    def test_boxes_lie_in_the_picture_and_no_two_cover_each_other(self, made):
        from sightline.vision_side.detect.port import overlap

        boxes, scores, labels = self.outputs(made, self.picture())
        kept = boxes[scores > 0]
        assert len(kept) > 3 and boxes.min() >= 0 and (boxes[:, 2:].max(axis=0) <= WHOLE_PX).all()
        assert set(labels.astype(int)) <= set(range(len(LABELS)))
        pairs = [(i, j) for i in range(len(kept)) for j in range(i)]
        assert max((overlap(tuple(kept[i]), tuple(kept[j])) for i, j in pairs), default=0.0) <= 0.5 + 1e-6

    def test_both_engines_agree(self, made):
        runtime = demanded.module("onnxruntime", "vision")
        session = runtime.InferenceSession(str(made), providers=["CPUExecutionProvider"])
        image = self.picture(5)
        theirs = dict(zip(("boxes", "scores", "labels"), session.run(["boxes", "scores", "labels"], {"image": image}),
                          strict=True))
        boxes, scores, labels = self.outputs(made, image)
        assert scores == pytest.approx(theirs["scores"], abs=1e-4) and (labels == theirs["labels"]).all()
        assert boxes == pytest.approx(theirs["boxes"], abs=0.05)

    def test_brightness_changes_little(self, made):
        image = (self.picture(6) // 2).astype(np.uint8)
        _, bright, _ = self.outputs(made, image)
        _, dim, _ = self.outputs(made, (image // 2).astype(np.uint8))
        assert np.sort(dim) == pytest.approx(np.sort(bright), abs=0.2)  # boxes as good as each other change places

    def test_a_black_and_a_white_picture_give_numbers(self, made):
        for value in (0, 255):
            boxes, scores, _ = self.outputs(made, np.full((1, *WHOLE_PX[::-1], 3), value, np.uint8))
            assert np.isfinite(boxes).all() and np.isfinite(scores).all()

    def test_a_threshold_becomes_one_half(self, made, tmp_path):
        from sightline.training.export import onnx_bytes, shifted

        _, before, labels = self.outputs(made, self.picture())
        thresholds = [0.2] * len(LABELS)
        (tmp_path / "shifted.onnx").write_bytes(onnx_bytes(shifted(weights(), thresholds), {}))
        _, after, _ = self.outputs(tmp_path / "shifted.onnx", self.picture())
        odds = before / (1 - before) / (0.2 / 0.8)
        seen = (before > 0.01) & (after > 0.01) & (labels >= 0)
        assert seen.any() and after[seen] == pytest.approx((odds / (1 + odds))[seen], abs=1e-3)
