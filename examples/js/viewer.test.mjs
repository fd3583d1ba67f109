/** @file The viewer on a WebSocket that is only made up: STOP, and a robot that falls silent. */

import assert from "node:assert/strict";
import test from "node:test";
import { encode } from "./codec.mjs";
import { helloText, pack, unpack } from "./framing.mjs";
import { Viewer } from "./viewer.mjs";

const SESSION = "0a1b2c3d";

/** What the page has sent, and what it was shown. Each connection that it opens is one of `sockets`. */
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
    this.viewer = new Viewer({ url: "ws://r1/", robot: "r1", look: () => null, show: (what) => this.shown.push(what), WebSocket: FakeSocket });
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

  status(state, applied = [0, 0]) {
    const header = { v: 1, session: SESSION, seq: (this.seq += 1), t_us: this.seq };
    const message = pack("status", header, encode({ state, reason: "as said", applied }));
    this.socket.onmessage({ data: message.buffer });
  }

  requests() {
    const binary = this.socket.sent.filter((data) => typeof data !== "string");
    return binary.map((data) => unpack(data, "", "r1")).filter((packet) => packet.channel.name === "request").length;
  }

  get stops() {
    return this.shown.filter((what) => "stop" in what).map((what) => what.stop);
  }
}

test("STOP is sent though the status at hand shows STOPPED: another operator may have reset since", (t) => {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  const rig = new Rig();
  rig.greet();
  rig.status("STOPPED");
  rig.socket.onclose({ code: 1006 });
  rig.viewer.stop();
  t.mock.timers.tick(200);
  rig.greet();
  t.mock.timers.tick(50);
  assert.ok(rig.requests() >= 1);
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

test("a robot that sends nothing for 2 s is left and connected to again", (t) => {
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
  rig.sockets[0].onmessage({ data: "no hello: it comes late, on the connection that was left" });
  assert.equal(rig.socket.closed, false);
  rig.viewer.close();
});

test("a robot that never says hello is left, too", (t) => {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  const rig = new Rig();
  rig.socket.onopen();
  t.mock.timers.tick(2000);
  t.mock.timers.tick(200);
  assert.deepEqual([rig.sockets.length, rig.sockets[0].closed], [2, true]);
  rig.viewer.close();
});
