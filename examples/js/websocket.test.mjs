/** @file Tests of one connection on a fake socket: its end, and silent or late peers. */

import assert from "node:assert/strict";
import { EventEmitter, once } from "node:events";
import { createServer } from "node:net";
import test from "node:test";
import { OPCODE, closePayload, encodeFrame } from "./rfc6455.mjs";
import { Connection, connect } from "./websocket.mjs";

const MASK = Uint8Array.from([1, 2, 3, 4]);
const fromClient = (opcode, payload = new Uint8Array(0)) => encodeFrame(opcode, payload, MASK);

/** The server end of one connection, in simulated time. */
class Rig {
  constructor({ mock }) {
    mock.timers.enable({ apis: ["setTimeout", "setInterval"] });
    mock.method(performance, "now", () => this.now_ms);
    this.timers = mock.timers;
    this.now_ms = 0;
    this.written = [];
    this.ends = [];
    this.isFull = false; // true if the kernel takes no bytes immediately
    this.socket = Object.assign(new EventEmitter(), {
      writable: true,
      setNoDelay: () => undefined,
      write: (frame, taken) => {
        this.written.push(frame[0] & 0x0f);
        if (this.isFull) this.taken = taken;
        else taken?.();
      },
      end: () => undefined, // the other end does not close
      destroy: () => this.socket.emit("close"),
    });
    this.connection = new Connection(this.socket, true);
    this.connection.onEnd = (end) => this.ends.push(end.code);
  }

  pass(ms, each = () => undefined) {
    for (let left = ms; left > 0; left -= 50) {
      this.now_ms += 50;
      this.timers.tick(50);
      each(this.now_ms);
    }
  }

  client(opcode, payload) {
    this.socket.emit("data", fromClient(opcode, payload));
  }
}

for (const payload of [new Uint8Array(0), closePayload(1000, "")]) {
  test(`a peer that sends Close (${payload.length} bytes) and keeps TCP open is dropped`, (t) => {
    const rig = new Rig(t);
    rig.client(OPCODE.CLOSE, payload);
    rig.connection.close(1001, "the robot is shutting down");
    rig.pass(1000);
    assert.deepEqual(rig.ends, [payload.length === 0 ? 1005 : 1000]);
  });
}

test("a peer that sends data stays connected with late pongs", (t) => {
  const rig = new Rig(t);
  rig.pass(5000, (now_ms) => now_ms % 100 === 0 && rig.client(OPCODE.BINARY, Uint8Array.of(1)));
  assert.deepEqual(rig.ends, []);
});

test("a peer that sends only late pongs stays connected, a silent one is dropped after 2 s", (t) => {
  const rig = new Rig(t);
  rig.pass(5200, (now_ms) => now_ms % 1300 === 0 && rig.client(OPCODE.PONG));
  assert.equal(rig.written.filter((opcode) => opcode === OPCODE.PING).length, 4);
  rig.pass(1900);
  assert.deepEqual(rig.ends, []);
  rig.pass(900);
  assert.deepEqual(rig.ends, [1011]);
});

test("a peer that reads slowly and answers no ping stays connected, and gets pings between messages", (t) => {
  const rig = new Rig(t);
  rig.isFull = true;
  rig.connection.next = () => Uint8Array.of(1);
  rig.connection.pump();
  rig.pass(100_000, (now_ms) => now_ms % 5000 === 0 && rig.taken());
  assert.deepEqual(rig.ends, []);
  assert.deepEqual(rig.written.slice(0, 4), [OPCODE.BINARY, OPCODE.PING, OPCODE.BINARY, OPCODE.BINARY]);
});

test("a peer that reads nothing for 30 s is dropped", (t) => {
  const rig = new Rig(t);
  rig.isFull = true;
  rig.connection.next = () => Uint8Array.of(1);
  rig.connection.pump();
  rig.pass(29_900);
  assert.deepEqual(rig.ends, []);
  rig.pass(900);
  assert.deepEqual(rig.ends, [1011]);
});

test("a peer may read the waiting message before it must answer the ping", (t) => {
  const rig = new Rig(t);
  rig.isFull = true;
  rig.connection.next = () => (rig.isFull ? Uint8Array.of(1) : undefined);
  rig.connection.pump();
  rig.pass(3000);
  rig.isFull = false;
  rig.taken();
  rig.pass(20_000);
  assert.deepEqual([rig.ends, rig.written.at(-1)], [[], OPCODE.PING]);
  rig.client(OPCODE.PONG);
  rig.pass(2900);
  assert.deepEqual(rig.ends, [1011]);
});

for (const start of ["HTTP/1.1 101 Switching Protocols\r\n", "HTTP/1.1 200 OK\r\n\r\n"]) {
  test(`a server that never ends its answer (${start.trim()}) is dropped after 2 s`, { timeout: 5000 }, async (t) => {
    t.mock.timers.enable({ apis: ["setTimeout"] });
    const server = createServer((socket) => {
      const drip = setInterval(() => socket.write("a: b\r\n"), 50);
      socket.on("error", () => undefined).on("close", () => clearInterval(drip)).write(start);
    }).listen(0, "127.0.0.1");
    t.after(() => server.close());
    await once(server, "listening");
    const opening = assert.rejects(connect(`ws://127.0.0.1:${server.address().port}`));
    const [socket] = await once(server, "connection");
    await once(socket, "data");
    t.mock.timers.tick(2000);
    await opening;
    await once(socket, "close");
  });
}
