/** @file Tests of the viewer on a fake WebSocket: STOP, and a robot that becomes silent. */

import assert from "node:assert/strict";
import test from "node:test";
import { encode } from "./codec.mjs";
import { DRAWN_CAMERA, drawJpeg } from "./drawing.mjs";
import { helloText, pack, unpack } from "./framing.mjs";
import { sessionDigest } from "./proof.mjs";
import { Viewer } from "./viewer.mjs";

const SESSION = "0a1b2c3d";
const JPEG = drawJpeg({ x_m: 0, y_m: 0, yaw_rad: 0 }, { x_m: 1, y_m: 0 });
const BLACK = { width: 1, height: 1, scale: 1, data: [0, 0, 0], channels: 3 };

/** Records the changes that the viewer shows, and the connections that it opens. */
class Rig {
  constructor() {
    const sockets = (this.sockets = []);
    this.shown = [];
    class FakeSocket {
      constructor() {
        this.bufferedAmount = 0;
        this.sent = [];
        this.closed = false;
        sockets.push(this);
      }

      send(data) {
        this.sent.push(data);
      }

      close() {
        this.closed = true;
      }
    }
    this.viewer = new Viewer({ url: "ws://r1/", robot: "r1", decodeImage: () => BLACK, show: (change) => this.shown.push(change), WebSocket: FakeSocket });
    this.viewer.open();
    this.seq = 0;
  }

  get socket() {
    return this.sockets.at(-1);
  }

  greet() {
    this.socket.onopen();
    this.socket.onmessage({ data: helloText("r1", SESSION, []) });
  }

  receive(channel, payload) {
    const header = { v: 1, session: SESSION, seq: (this.seq += 1), t_us: this.seq };
    this.socket.onmessage({ data: pack(channel, header, payload).buffer });
  }

  status(state, applied = [0, 0]) {
    this.receive("status", encode({ state, reason: "a reason", applied }));
  }

  /** Deliver a frame. @returns {Promise<string[]>} channels of all messages sent when it is drawn */
  async frame() {
    this.receive("frame", JPEG);
    await new Promise(setImmediate);
    return this.packets().map((packet) => packet.channel.name);
  }

  packets() {
    return this.socket.sent.filter((data) => typeof data !== "string").map((data) => unpack(data, "", "r1"));
  }

  requests() {
    return this.packets().filter((packet) => packet.channel.name === "request");
  }

  get stops() {
    return this.shown.filter((change) => "stop" in change).map((change) => change.stop);
  }
}

test("STOP is sent although the last status shows STOPPED, because another operator may have reset the robot", (t) => {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  const rig = new Rig();
  rig.greet();
  rig.status("STOPPED");
  rig.socket.onclose({ code: 1006 });
  rig.viewer.stop();
  t.mock.timers.tick(200);
  rig.greet();
  t.mock.timers.tick(50);
  assert.ok(rig.requests().length >= 1);
  assert.ok(!rig.stops.includes("STOPPED"), rig.stops.join());
  rig.status("ACTIVE", [0.2, 0]);
  t.mock.timers.tick(50);
  rig.status("STOPPED", [0.1, 0]);
  t.mock.timers.tick(50);
  assert.ok(!rig.stops.includes("STOPPED"), "the wheels still turn");
  rig.status("STOPPED");
  t.mock.timers.tick(50);
  assert.equal(rig.stops.at(-1), "STOPPED");
  rig.viewer.close();
});

test("a page has the role viewer unless it drives, so that it takes no place of a driver", () => {
  const rig = new Rig();
  rig.greet();
  for (const drives of [true, false]) rig.viewer.setDriving(drives);
  const hellos = rig.socket.sent.filter((data) => typeof data === "string");
  assert.deepEqual(hellos.map((text) => JSON.parse(text).role), ["viewer", "vision", "viewer"]);
  rig.viewer.close();
});

test("requests have the role operator whether the page drives or not, because no other token permits them", () => {
  const rig = new Rig();
  rig.greet();
  for (const drives of [false, true]) {
    rig.viewer.setDriving(drives);
    const id = rig.viewer.request("arm");
    assert.equal(rig.requests().at(-1).source, "operator");
    rig.receive("reply", encode({ to: sessionDigest("operator", rig.viewer.session), id, ok: true, state: "HOLD", detail: "armed" }));
    assert.equal(rig.shown.at(-1).reply?.id, id);
  }
  rig.viewer.close();
});

test("the page sends no twist after STOP until the robot confirms it", async (t) => {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  const rig = new Rig();
  rig.greet();
  rig.viewer.setDriving(true);
  rig.receive("camera", encode(DRAWN_CAMERA));
  assert.deepEqual(await rig.frame(), ["twist"]);
  rig.viewer.stop();
  t.mock.timers.tick(1000);
  rig.socket.sent.length = 0;
  assert.deepEqual(await rig.frame(), []);
  rig.status("STOPPED");
  t.mock.timers.tick(50);
  assert.deepEqual(await rig.frame(), ["twist"]);
  rig.viewer.close();
});

test("a robot that is silent for 2 s is disconnected, and the viewer reconnects", (t) => {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  const rig = new Rig();
  t.mock.timers.tick(1500);
  rig.greet();
  for (let count = 0; count < 5; count += 1) {
    t.mock.timers.tick(1500);
    rig.status("ACTIVE");
  }
  assert.equal(rig.sockets.length, 1);
  t.mock.timers.tick(1999);
  assert.equal(rig.socket.closed, false);
  t.mock.timers.tick(1);
  t.mock.timers.tick(200);
  assert.deepEqual([rig.sockets.length, rig.sockets[0].closed], [2, true]);
  rig.sockets[0].onmessage({ data: "invalid hello, late, on the dropped connection" });
  assert.equal(rig.socket.closed, false);
  rig.viewer.close();
});

test("a robot that never sends a hello is disconnected", (t) => {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  const rig = new Rig();
  rig.socket.onopen();
  t.mock.timers.tick(2000);
  t.mock.timers.tick(200);
  assert.deepEqual([rig.sockets.length, rig.sockets[0].closed], [2, true]);
  rig.viewer.close();
});
