"""The scripts of the pages of `watch` and `pick-color`, in Node without a browser."""

import subprocess
from pathlib import Path

import pytest

from sightline.operator_side.cockpit import http_server
from tests.fixtures.javascript import node

PAGES = Path(http_server.__file__).parent / "pages"
SCRIPT = """
let requests = 0;
globalThis.document = { getElementById: () => ({ style: {} }), body: { dataset: { live: "true" } } };
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
