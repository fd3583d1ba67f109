"""The scale page: its tables follow from measured figures, and the arithmetic is that of a calculation by hand."""

import os
import shutil
import time
from dataclasses import replace

import pytest

from docs.make import scale
from docs.make.scale import DOCS, PAGE, PERFORMANCE, ROUTER, Assumptions, Figures, main, page_text, plan, read_figures

FIGURES = Figures(frame_bytes=50_000, vision_ms=3.0, hsv_ms=0.25, onnx_ms=2.25, memory_mb=100, router_us=300,
                  router_date="2026-11-26")
GIVEN = Assumptions(fps=10, busy=0.5, nic_gbit=10, core_hour=0.1, gpu_hour=2, gigabyte=0.01, gpu_fps=200)


@pytest.fixture
def docs(tmp_path):
    """A copy of what the script reads and writes."""
    for path in (PAGE, PERFORMANCE, ROUTER):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(DOCS / path, tmp_path / path)
    return tmp_path


def test_tables_of_the_page_are_current():
    page = (DOCS / PAGE).read_text("utf-8")
    assert page_text(page, read_figures(), Assumptions()) == page, "run `python -m docs.make.scale`"


def test_figures_are_those_of_the_performance_page(docs):
    figures = read_figures(docs)
    page = docs / PERFORMANCE
    text = page.read_text("utf-8")
    assert f"| {figures.frame_bytes:.0f} | guardian" in text and f"vision {figures.vision_ms:g} |" in text
    page.write_text(text.replace(f"| {figures.frame_bytes:.0f} |", "| 12345 |"), "utf-8")
    assert read_figures(docs) == replace(figures, frame_bytes=12345.0)
    page.write_text(text.replace("| sightline |", "| other |"), "utf-8")
    with pytest.raises(ValueError, match="no 'bytes a picture' of 'sightline' in 'The whole loop'"):
        read_figures(docs)


def test_one_robot_needs_one_service_and_no_router():
    one = plan(1, FIGURES, GIVEN)
    assert (one.frames_s, one.mbit_s, one.sites, one.router_cores, one.services, one.gpus) == (10, 4, 0, 0, 1, 0)
    assert one.cost == pytest.approx(0.1 + 4 / 8e3 * 3600 * 0.01)


def test_fleet_is_that_of_a_calculation_by_hand():
    one = plan(100, FIGURES, GIVEN, extra_ms=2.0, on_gpu=True)
    # 1,000 frames/s: 5 ms each is 5 cores, 10 at half load, and one to spare; routers 0.3 cores, 0.6 at half load.
    assert (one.frames_s, one.mbit_s, one.sites) == (1000, 400, 1)
    assert (one.services, one.router_cores, one.cores) == (11, 2, 13)
    assert one.gpus == 10 and one.memory_gb == pytest.approx(1.1)
    assert one.cost == pytest.approx((13 * 0.1 + 10 * 2 + 400 / 8e3 * 3600 * 0.01) / 100)


@pytest.mark.parametrize(("robots", "nic_gbit", "sites"), [
    (1250, 10, 2),  # 5 Gbit/s is one network card at half load, but there are more than 1,000 sessions
    (1250, 2, 5), (890, 10, 1), (920, 10, 2),
])  # fmt: skip
def test_sites_follow_from_sessions_and_network_cards(robots, nic_gbit, sites):
    found = plan(robots, FIGURES, replace(GIVEN, nic_gbit=nic_gbit))
    assert found.sites == sites
    assert -(-robots // sites) + found.services / sites + scale.SPARE_SESSIONS <= scale.MAX_SESSIONS
    assert robots * 0.4 / sites * 10 / GIVEN.fps <= nic_gbit * 1e3 * GIVEN.busy


def test_prices_and_assumptions_are_marked():
    text = "\n".join(scale.lines(FIGURES, GIVEN))
    assert text.count("**example**, not of a provider") == 1 and text.count("**assumed**, not measured") == 1
    assert "0.1 an hour, 2 an hour, 0.01" in text


def test_other_values_are_printed_and_not_written(docs, capsys):
    before = (docs / PAGE).read_text("utf-8")
    assert main(["--print", "--fps", "15", "--core-hour", "0.5"], docs) == 0
    shown = capsys.readouterr().out
    assert "| 1 | 15 |" in shown and "| 0.5000 |" in shown
    (docs / PAGE).write_text(before.replace("| 1,500 |", "| 9 |"), "utf-8")
    assert main([], docs) == 0
    assert (docs / PAGE).read_text("utf-8") == before


@pytest.mark.parametrize("arguments", [
    ["--fps", "15"], ["--print", "--fps", "0"], ["--print", "--busy", "1.5"], ["--print", "--core-hour", "-1"],
    ["--print", "--gpu-fps", "nan"], ["--print", "--gpu-hour", "inf"], ["--print", "--fps", "many"],
])  # fmt: skip
def test_invalid_value_is_one_error(arguments, docs, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments, docs)
    assert ended.value.code == 2
    assert " error: " in capsys.readouterr().err.splitlines()[-1]


def test_page_without_marks_is_an_error():
    with pytest.raises(ValueError, match="expected one"):
        page_text("# Title\n", FIGURES, GIVEN)


def test_cpu_time_of_a_process_is_read():
    end_s = time.process_time() + 0.05
    while time.process_time() < end_s:
        pass
    assert scale._cpu_s(os.getpid()) == pytest.approx(time.process_time(), rel=0.2, abs=0.2)
