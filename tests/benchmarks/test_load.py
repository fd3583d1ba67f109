"""A measurement beside other programs names their share of the machine, because its checks may fail."""

from types import SimpleNamespace

import pytest

from sightline.benchmarks import costs, pipeline
from sightline.benchmarks.loop import counters
from sightline.benchmarks.loop.counters import Reading
from sightline.operator_side.cli import bench
from tests.fixtures.commands import run


@pytest.mark.parametrize(("others", "line"), [
    (0.0, ""), (5.0, ""), (5.4, "bench: others used 5 % of this machine; close other programs and repeat\n"),
    (83.0, "bench: others used 83 % of this machine; close other programs and repeat\n"),
])
@pytest.mark.parametrize("name", ["codec", "gate", "pipeline"])
def test_bench_names_the_load_of_other_programs(monkeypatch, capsys, name: str, others: float, line: str) -> None:
    readings = [Reading({}, own_s=1.0, busy_s=10.0, steal_s=0.0), Reading({}, 3.0, busy_s=12.0 + others, steal_s=0.0)]
    seconds = iter([7.0, 57.0])
    monkeypatch.setattr(counters.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(counters, "read_machine", lambda _pids: readings.pop(0))
    monkeypatch.setattr(bench.time, "monotonic", lambda: next(seconds))
    monkeypatch.setattr(costs, "measure_codec", lambda: [] if len(readings) == 1 else None)
    for measure in ("measure_gate", "measure_proof"):
        monkeypatch.setattr(costs, measure, lambda: 1.0 if len(readings) == 1 else None)
    times = dict.fromkeys(("alone_us", "whole_us", "decode_us", "network_us", "two_us", "missed", "false"), 0)
    learned = SimpleNamespace(engine="x", **times)
    monkeypatch.setattr(pipeline, "time_steps", list)
    monkeypatch.setattr(pipeline, "time_learned", lambda: learned if len(readings) == 1 else None)
    code, out, err = run(capsys, "bench", name, "--json")
    assert (code, err, readings) == (0, line, []) and out.startswith('{"ok": true')
