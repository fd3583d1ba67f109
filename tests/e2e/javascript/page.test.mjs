/** @file Tests of the viewer page on fake elements, sockets and images: old images and states do not look current. */

import assert from "node:assert/strict";
import { beforeEach, mock, test } from "node:test";
import { encode } from "../../../examples/js/codec.mjs";
import { drawJpeg } from "../../../examples/js/drawing.mjs";
import { helloText, pack, unpack } from "../../../examples/js/framing.mjs";
import { sessionDigest } from "../../../examples/js/proof.mjs";

const SESSION = "0a1b2c3d";
const JPEG = drawJpeg({ x_m: 0, y_m: 0, yaw_rad: 0 }, { x_m: 1, y_m: 0 });
const parts = {};
const sockets = [];
let now_ms = 10_000;
let seq = 0;

class FakeElement {
  textContent = "";
  className = "";

  getContext() {
    return { drawImage: () => undefined, getImageData: (x, y, width, height) => ({ data: new Uint8Array(4 * width * height) }) };
  }
}

class FakeSocket {
  bufferedAmount = 0;

  constructor() {
    sockets.push(this);
  }

  sent = [];

  send(data) {
    this.sent.push(data);
  }

  close() {}
}

mock.timers.enable({ apis: ["setTimeout", "setInterval"] });
mock.method(performance, "now", () => now_ms);
Object.assign(globalThis, {
  document: { getElementById: (id) => (parts[id] ??= new FakeElement()), addEventListener: () => undefined, body: { dataset: { robot: "r1" } } },
  location: { protocol: "http:", host: "r1", hash: "", reload: mock.fn() },
  WebSocket: FakeSocket,
  createImageBitmap: async () => ({ width: 8, height: 8, close: () => undefined }),
});
await import("../../../examples/js/page.mjs");

function pass(ms) {
  for (let left = ms; left > 0; left -= 50) {
    now_ms += 50;
    mock.timers.tick(50);
  }
}

/** Deliver a message with a time `late_ms` ago. */
async function receive(channel, payload, late_ms = 0) {
  const header = { v: 1, session: SESSION, seq: (seq += 1), t_us: (now_ms - late_ms) * 1000 };
  sockets.at(-1).onmessage({ data: pack(channel, header, payload).buffer });
  await new Promise(setImmediate); // until the image is drawn
}

const receiveStatus = (state = "ACTIVE", applied = [0.4, 0]) => receive("status", encode({ state, reason: "drives", applied }));

/** Deliver the reply to the newest request of this page. */
function receiveReply(detail, state = "DISARMED") {
  parts.arm.onclick();
  const { header } = unpack(sockets.at(-1).sent.at(-1), "", "r1");
  const { source, session } = JSON.parse(new TextDecoder().decode(header));
  return receive("reply", encode({ to: sessionDigest(source, session), id: 1, ok: state === "ACTIVE", state, detail }));
}

beforeEach(() => {
  sockets.at(-1).onopen();
  sockets.at(-1).onmessage({ data: helloText("r1", SESSION, []) });
});

test("a late image is dimmed, and its age includes its delay", async () => {
  await receiveStatus();
  await receive("frame", JPEG, 20);
  pass(100);
  assert.deepEqual([parts.age.textContent, parts.figure.className], ["1 images/s, at least 120 ms old", ""]);
  await receive("frame", JPEG, 0);
  await receiveStatus();
  pass(1200);
  assert.deepEqual([parts.age.textContent, parts.figure.className], ["no image for 1.2 s", "old"]);
  await receive("frame", JPEG, 1150);
  pass(100);
  assert.deepEqual([parts.age.textContent, parts.figure.className], ["1 images/s, at least 1250 ms old", "old"]);
});

const stateShown = () => ["state", "reason", "wheels", "driver", "frame_age", "frames"].map((id) => parts[id].textContent);
const UNKNOWN = ["?", "", "?", "?", "?", "?"];

test("the page shows no state 1 s after the last status, although frames arrive", async () => {
  await receiveStatus();
  assert.deepEqual([...stateShown().slice(0, 2), parts.state.className], ["ACTIVE", "drives", "ACTIVE"]);
  for (let count = 0; count < 9; count += 1) {
    pass(100);
    await receive("frame", JPEG);
  }
  assert.equal(parts.state.textContent, "ACTIVE");
  pass(200);
  assert.deepEqual([stateShown(), parts.state.className], [UNKNOWN.with(1, "no status for more than 1 s"), ""]);
  assert.equal(parts.link.textContent, "connected");
  await receiveStatus();
  assert.equal(parts.state.textContent, "ACTIVE");
});

test("an invalid status does not prolong the state", async () => {
  await receiveStatus();
  for (let count = 0; count < 12; count += 1) {
    pass(100);
    await receive("status", encode({ state: "ACTIVE", reason: 1, applied: [0.4, 0] }));
  }
  assert.deepEqual(stateShown(), UNKNOWN.with(1, "no status for more than 1 s"));
});

test("the result of a request disappears with the state that followed it", async () => {
  await receiveStatus("DISARMED");
  await receiveReply("NOT_ALLOWED: repeat the request");
  await receiveStatus("DISARMED");
  assert.equal(parts.message.textContent, "NOT_ALLOWED: repeat the request");
  await receiveStatus("ACTIVE");
  assert.equal(parts.message.textContent, "");
});

test("an unconfirmed STOP stays on the page, and STOPPED disappears with the state", async () => {
  parts.stop.onclick();
  await receiveStatus();
  assert.equal(parts.message.textContent, "STOP ...");
  await receiveStatus("STOPPED", [0, 0]);
  pass(50);
  await receiveStatus("STOPPED", [0, 0]);
  assert.equal(parts.message.textContent, "STOPPED");
  await receiveStatus("DISARMED", [0, 0]);
  assert.equal(parts.message.textContent, "");
});

test("a page that wakes shows the age of its image and state immediately, before any timer", async () => {
  for (const wakes of ["onvisibilitychange", "onresume"]) {
    await receiveStatus();
    await receive("frame", JPEG);
    now_ms += 5000;
    document[wakes]();
    assert.deepEqual([parts.age.textContent, parts.figure.className, parts.state.textContent], ["no image for 5.0 s", "old", "?"]);
  }
});

test("a page without a connection names the token, and reloads with a token added to its address", () => {
  sockets.at(-1).onerror();
  assert.match(parts.link.textContent, /no answer.*token.*#/);
  globalThis.onhashchange();
  assert.equal(location.reload.mock.callCount(), 1);
  pass(1500);
});

test("a lost connection clears the state", async () => {
  await receiveStatus();
  await receiveReply("armed", "ACTIVE");
  assert.equal(parts.message.textContent, "armed");
  sockets.at(-1).onclose({ code: 1006 });
  assert.deepEqual([stateShown(), parts.state.className, parts.link.className], [UNKNOWN, "", "lost"]);
  assert.equal(parts.message.textContent, "");
  pass(1500);
  assert.deepEqual(stateShown(), UNKNOWN);
});
