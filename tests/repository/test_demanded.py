"""A missing tool fails the tests that need it if the environment demands it; otherwise they skip with the fix."""

import re
import sys
from pathlib import Path

import pytest

from tests.fixtures import demanded, javascript

ROOT = Path(__file__).parent.parent.parent


def test_missing_tool_skips_and_fails_where_it_is_demanded(monkeypatch):
    monkeypatch.delenv(demanded.NAME, raising=False)
    with pytest.raises(pytest.skip.Exception, match="no wheel"):
        demanded.do_without("triton", "no wheel")
    monkeypatch.setenv(demanded.NAME, "cuda,triton")
    with pytest.raises(pytest.fail.Exception, match="'triton', and it cannot be had: no wheel") as failed:
        demanded.do_without("triton", "no wheel")
    assert "\n" not in str(failed.value)


@pytest.mark.parametrize(("demand", "outcome"), [("", pytest.skip.Exception), ("node,chromium", pytest.fail.Exception)])
@pytest.mark.parametrize(("find", "fix"), [
    (javascript.node, "apt-get install nodejs"), (javascript.chromium, "apt-get install chromium"),
])  # fmt: skip
def test_missing_program_is_reported_with_the_fix(monkeypatch, demand, outcome, find, fix):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv(demanded.NAME, demand)
    with pytest.raises(outcome, match=fix):
        find()


@pytest.mark.parametrize(("demand", "outcome"), [("", pytest.skip.Exception), ("torch", pytest.fail.Exception)])
def test_missing_module_is_reported_with_its_extra(monkeypatch, demand, outcome):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setenv(demanded.NAME, demand)
    with pytest.raises(outcome, match=re.escape("pip install -e '.[train]'")):
        demanded.module("torch", "train")


def test_installed_module_is_returned():
    assert demanded.module("os.path", "dev") is __import__("os").path


def test_ci_demands_each_tool_that_no_extra_for_tests_installs():
    script = (ROOT / ".ci" / "run").read_text()
    assert set(re.findall(r"^demand (\w+)", script, re.MULTILINE)) >= {"chromium", "node", "torch", "triton"}
    assert re.search(r"\bdemanded=cpu\b", script) and f"export {demanded.NAME}=$demanded" in script


def test_no_test_skips_without_naming_the_fix():
    """It names no fix and no demand can turn it into a failure."""
    texts = {path: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py")}
    found = [str(path) for path, text in texts.items() if "importorskip" + "(" in text]
    assert found == [], "use tests/fixtures/demanded.py"
