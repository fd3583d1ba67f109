/** @file Tests of the STOP port. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { Gate } from "./gate.mjs";
import { DATAGRAM_BYTES, StopPort } from "./stop_port.mjs";

const vector = (name) => Buffer.from(JSON.parse(readFileSync(new URL(`../../protocol/vectors/stop/${name}.json`, import.meta.url))).datagram_hex, "hex");
const opened = (robot = "r1") => new StopPort(robot, new Gate("0a1b2c3d"), Buffer.alloc(16, 7));

test("a STOP latches STOPPED, and its answer names robot, counter, state and numbers", () => {
  const port = opened();
  const data = vector("stop");
  assert.equal(port.gate.state, "DISARMED");
  for (const count of [1n, 2n]) {
    assert.equal(port.onDatagram(data), true);
    const answer = port.answer(data, true);
    assert.equal(port.gate.state, "STOPPED");
    assert.equal(answer.length, DATAGRAM_BYTES);
    assert.deepEqual([...answer.subarray(0, 8)], [...Buffer.from("STOP"), 1, 2, 5, 3]);
    assert.deepEqual(answer.subarray(8, 48), data.subarray(8, 48));
    assert.deepEqual([...answer.subarray(48, 64)], Array(16).fill(7));
    assert.deepEqual([answer.readBigUInt64BE(64), answer.readBigUInt64BE(72)], [count, count]);
    assert.deepEqual([...answer.subarray(80)], Array(32).fill(0));
  }
  assert.equal(port.answer(data, false)[7], 1); // the latch is not on disk
});

for (const [name, reason] of [["cut", "MALFORMED"], ["long", "MALFORMED"], ["empty", "MALFORMED"], ["magic", "MALFORMED"],
  ["kind_0", "MALFORMED"], ["answer", "MALFORMED"], ["register", "MALFORMED"], ["state_7", "MALFORMED"], ["version_2", "UNSUPPORTED_VERSION"]]) {
  test(`the datagram ${name} stops nothing and is counted as ${reason}`, () => {
    const port = opened();
    assert.equal(port.onDatagram(vector(name)), false);
    assert.equal(port.gate.state, "DISARMED");
    assert.deepEqual(port.gate.counters, { [reason]: 1 });
  });
}

test("a STOP for another robot stops nothing, also if one id begins with the other", () => {
  for (const robot of ["r", "r10", "R1"]) {
    const port = opened(robot);
    assert.equal(port.onDatagram(vector("stop")), false);
    assert.deepEqual([port.gate.state, port.gate.counters.OTHER_ROBOT], ["DISARMED", 1]);
  }
});
