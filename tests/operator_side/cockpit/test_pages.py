"""The scripts of the pages of `watch` and `pick-color`, in Node without a browser."""

import json
import subprocess
from pathlib import Path

import pytest

from sightline.operator_side.cockpit import http_server
from tests.fixtures.javascript import node

PAGES = Path(http_server.__file__).parent / "pages"
SCRIPT = """
let requests = 0;
const element = { style: {}, replaceChildren() {} };
globalThis.document = { getElementById: () => element, body: { dataset: { live: "true" } } };
globalThis.setInterval = globalThis.setTimeout = () => 0; // no pause ends
globalThis.fetch = async (path) => {
  if (path.startsWith("picture") && (requests += 1) > 20) process.exit(7);
  return { ok: false, status: 404, headers: new Headers() };
};
await import(process.argv[1]);
setImmediate(() => process.exit(requests === 1 ? 0 : 8));
"""


@pytest.mark.parametrize("name", ["pick.mjs", "watch.mjs"])
def test_page_pauses_after_a_rejected_request(name):
    command = [node(), "--input-type=module", "-e", SCRIPT, (PAGES / name).as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 0, done.stderr


ENDING_SCRIPT = """
const parts = {};
const element = () => ({ style: {}, replaceChildren(...children) { this.children = children; } });
globalThis.document = { getElementById: (id) => (parts[id] ??= element()), createElement: element };
globalThis.setInterval = () => 0;
globalThis.setTimeout = (next) => setImmediate(next);
const state = { robot: "r1", online: true, state: "ACTIVE", reason: "drives", lines: [["wheels", "+0.40 m/s"]] };
let states = 0;
AbortSignal.timeout = (time_ms) => {
  const limit = new AbortController();
  if (time_ms <= 1000) setImmediate(() => limit.abort(new DOMException("too late", "TimeoutError")));
  return limit.signal;
};
globalThis.fetch = async (path, { signal } = {}) => {
  if (path !== "state") return new Promise(() => undefined);
  if ((states += 1) > 2) {
    const { link, state, reason, lines } = parts;
    const texts = [link.textContent, state.textContent, state.className, reason.textContent];
    console.log(JSON.stringify([...texts, lines.children]));
    process.exit(0);
  }
  if (states === 2 && process.argv[2] === "has ended") throw new TypeError("no connection");
  if (states === 2 && process.argv[2] === "does not answer") {
    return new Promise((_, fail) => signal.addEventListener("abort", () => fail(signal.reason)));
  }
  return { json: async () => (states === 2 ? { error: "too many" } : state) };
};
await import(process.argv[1]);
"""


@pytest.mark.parametrize(("end", "shown"), [
    ("has ended", "`sightline watch` has ended"), ("does not answer", "`sightline watch` does not answer"),
    ("rejects", "too many"),
])
def test_page_shows_no_state_after_the_command_ended_hangs_or_rejects(end, shown):
    command = [node(), "--input-type=module", "-e", ENDING_SCRIPT, (PAGES / "watch.mjs").as_uri(), end]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert json.loads(done.stdout) == [shown, "", "", "", []], done.stderr


LOST_SCRIPT = """
const parts = {};
const element = () => ({ style: {} });
globalThis.document = { getElementById: (id) => (parts[id] ??= element()), body: { dataset: { live: "true" } } };
globalThis.fetch = async () => { throw new TypeError("no connection"); };
await import(process.argv[1]);
await parts.use.onclick();
console.log(parts.error.textContent);
process.exit(0);
"""


def test_page_that_cannot_save_the_range_shows_it():
    command = [node(), "--input-type=module", "-e", LOST_SCRIPT, (PAGES / "pick.mjs").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert done.stdout == "`sightline pick-color` has ended\n", done.stderr


WAKING_SCRIPT = """
const parts = {};
const element = () => ({ style: {}, getContext: () => ({ drawImage() {} }), replaceChildren() {} });
globalThis.document = { getElementById: (id) => (parts[id] ??= element()) };
globalThis.setInterval = globalThis.setTimeout = () => 0; // no timer runs in a page that sleeps
globalThis.createImageBitmap = async () => ({ width: 8, height: 8, close() {} });
let now_ms = 0;
performance.now = () => now_ms;
const headers = new Headers({ "X-Number": "1", "X-Channel": "frame", "X-Age-Us": "20000" });
let requests = 0;
const answer = { ok: true, headers, blob: async () => 0 };
globalThis.fetch = async () => ((requests += 1) > 1 ? new Promise(() => 0) : answer);
await import(process.argv[1]);
await new Promise(setImmediate);
for (const wakes of ["onvisibilitychange", "onresume"]) {
  now_ms += 5000;
  document[wakes]();
  console.log(parts.age.textContent, parts.figure.className);
}
process.exit(0);
"""


def test_page_that_wakes_shows_at_once_how_old_its_image_is():
    command = [node(), "--input-type=module", "-e", WAKING_SCRIPT, (PAGES / "watch.mjs").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert done.stdout == "no image for 5.0 s old\nno image for 10.0 s old\n", done.stderr
