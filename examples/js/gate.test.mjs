/** @file Tests of the gate at the boundaries of every rule, in the order of validation, in simulated time. */

import assert from "node:assert/strict";
import test from "node:test";
import { WireError } from "./codec.mjs";
import { Gate } from "./gate.mjs";
import { ProofChain } from "./proof.mjs";
import { LIMITS, Ramp, TICK_US, ageFactor, clampTwist } from "./limits.mjs";

const ROBOT = "0a1b2c3d";
const FORWARD = { linear_mps: 0.4, angular_rad_s: 0 };
const START_US = 50_000_000;

/** A gate with a clock. `frame` issues a frame now, `command` answers one. */
class Rig {
  constructor(limits = {}, stopped = false) {
    this.gate = new Gate(ROBOT, limits, stopped);
    this.now_us = START_US;
    this.frames = this.commands = 0;
  }

  pass(us) {
    this.now_us += us;
  }

  frame(channel = "frame") {
    this.frames += 1;
    this.gate.issued.add(channel, this.frames, this.now_us);
    return { channel, session: ROBOT, seq: this.frames, t_us: this.now_us };
  }

  command(echo, { source = "vision", session = "4e5f6071", twist = FORWARD, seq = undefined, ...proof } = {}) {
    this.commands += 1;
    const header = { source, session, seq: seq ?? this.commands, echo, compute_us: 0, ...proof };
    return this.gate.offer(source, header, twist, this.now_us);
  }

  request(verb, { source = "operator", session = "aaaaaaaa", echo = this.frame("status") } = {}) {
    return this.gate.request({ source, session, echo }, verb, this.now_us);
  }

  /** Send five live commands, then arm. */
  arm(sender = {}) {
    for (let count = 0; count < 5; count += 1) {
      this.pass(TICK_US);
      assert.equal(this.command(this.frame(), sender), "DISARMED");
    }
    assert.equal(this.request("arm", sender.source === "teleop" ? sender : {}), "armed");
  }

  drive(ticks, sender = {}) {
    for (let count = 0; count < ticks; count += 1) {
      this.pass(TICK_US);
      assert.equal(this.command(this.frame(), sender), null);
      this.gate.step(this.now_us);
    }
  }

  stepUntil(state, most_us) {
    const since_us = this.now_us;
    while (this.gate.state !== state || this.gate.applied.linear_mps !== 0) {
      assert.ok(this.now_us - since_us <= most_us, `${this.gate.state} after ${most_us} us`);
      this.pass(TICK_US);
      this.gate.step(this.now_us);
    }
    return this.now_us - since_us;
  }
}

const rejects = (reason, act) => assert.throws(act, (error) => error instanceof WireError && error.reason === reason);

test("an operator can arm after five live commands, not earlier", () => {
  const rig = new Rig();
  rejects("NOT_ALLOWED", () => rig.request("arm"));
  for (let count = 0; count < 4; count += 1) rig.command(rig.frame());
  rejects("NOT_ALLOWED", () => rig.request("arm"));
  rig.command(rig.frame());
  assert.equal(rig.request("arm"), "armed");
  assert.equal(rig.gate.state, "HOLD");
  assert.equal(rig.request("arm"), "already armed");
});

const CITATIONS = [
  ["another session of the robot", (echo) => ({ ...echo, session: "ffffffff" }), 0, "OTHER_SESSION"],
  ["an unknown seq", (echo) => ({ ...echo, seq: 999 }), 0, "UNKNOWN_FRAME"],
  ["another time", (echo) => ({ ...echo, t_us: echo.t_us + 1 }), 0, "UNKNOWN_FRAME"],
  ["the reserved beat", (echo) => ({ ...echo, channel: "beat" }), 0, "UNKNOWN_FRAME"],
  ["a frame of the largest age", (echo) => echo, 400_000, null],
  ["a frame that is a microsecond older", (echo) => echo, 400_001, "STALE"],
  ["a frame from the future", (echo) => echo, -1, "FROM_FUTURE"],
];
for (const [name, change, later_us, expected] of CITATIONS) {
  test(`a command that cites ${name}: ${expected ?? "accepted"}`, () => {
    const rig = new Rig();
    rig.arm();
    const echo = change(rig.frame());
    rig.pass(later_us);
    assert.equal(rig.command(echo), expected);
    assert.equal(rig.gate.counters[expected] ?? 0, expected === null ? 0 : 1);
  });
}

test("a twist that cites a status is rejected", () => {
  const rig = new Rig();
  assert.equal(rig.command(rig.frame("status")), "UNKNOWN_FRAME");
});

test("seq must increase within a source and session", () => {
  const rig = new Rig();
  rig.arm();
  assert.equal(rig.command(rig.frame(), { seq: 100 }), null);
  assert.equal(rig.command(rig.frame(), { seq: 100 }), "OUT_OF_ORDER");
  assert.equal(rig.command(rig.frame(), { seq: 99 }), "OUT_OF_ORDER");
  assert.equal(rig.command(rig.frame(), { seq: 101 }), null);
});

test("a viewer, a guest while guests are off, and a header of another role are rejected", () => {
  const rig = new Rig();
  assert.equal(rig.command(rig.frame(), { source: "viewer" }), "UNKNOWN_SOURCE");
  assert.equal(rig.command(rig.frame(), { source: "constructor" }), "UNKNOWN_SOURCE");
  assert.equal(rig.gate.offer("guest", null, FORWARD, rig.now_us), "UNKNOWN_SOURCE");
  assert.equal(rig.gate.offer("teleop", { source: "vision" }, FORWARD, rig.now_us), "UNKNOWN_SOURCE");
});

test("a guest has lower speed limits, a shorter command life and the lowest rank", () => {
  const rig = new Rig({ guests: true, autoArm: true });
  for (let count = 0; count < 60; count += 1) {
    rig.pass(TICK_US);
    rig.gate.offer("guest", null, { linear_mps: 5 + count, angular_rad_s: 0 }, rig.now_us);
    rig.gate.step(rig.now_us);
  }
  assert.equal(rig.gate.frameAge_us(rig.now_us), null);
  assert.ok(Math.abs(rig.gate.applied.linear_mps - 0.2) < 1e-9);
  rig.pass(250_001);
  rig.gate.step(rig.now_us);
  assert.equal(rig.gate.state, "HOLD");
  assert.equal(rig.command(rig.frame()), null);
  assert.equal(rig.gate.offer("guest", null, FORWARD, rig.now_us), "NOT_HOLDER");
});

for (const [speed_mps, most_m] of [[0.2, 0.27], [0.05, 0.11]]) {
  test(`a guest that repeats ${speed_mps} m/s is stopped after 2 s or 0.25 m, until the twist changes`, () => {
    const rig = new Rig({ guests: true, autoArm: true });
    let driven_m = 0;
    const repeat = (linear_mps, ticks) => {
      for (let count = 0; count < ticks; count += 1) {
        rig.pass(TICK_US);
        rig.gate.offer("guest", null, { linear_mps, angular_rad_s: 0 }, rig.now_us);
        driven_m += (rig.gate.step(rig.now_us).linear_mps * TICK_US) / 1e6;
      }
    };
    repeat(speed_mps, 500);
    assert.deepEqual([rig.gate.state, rig.gate.applied.linear_mps], ["HOLD", 0]);
    assert.ok(driven_m > 0.05 && driven_m < most_m, `${driven_m} m`);
    repeat(speed_mps + 0.01, 20);
    assert.equal(rig.gate.state, "ACTIVE");
    repeat(0, 200);
    assert.equal(rig.gate.state, "ACTIVE");
  });
}

test("silence stops the robot within 700 ms and disarms it after 10 s", () => {
  const rig = new Rig();
  rig.arm();
  rig.drive(60);
  assert.ok(Math.abs(rig.gate.applied.linear_mps - 0.4) < 1e-9);
  assert.ok(rig.stepUntil("HOLD", 700_000) >= 300_000);
  assert.ok(rig.stepUntil("DISARMED", 10_100_000) >= 9_900_000);
});

test("rejected commands do not prolong the last accepted one", () => {
  const rig = new Rig();
  rig.arm();
  rig.drive(60);
  const echo = rig.frame();
  for (let count = 0; count < 35; count += 1) {
    rig.pass(TICK_US);
    rig.command({ ...echo, seq: 999 });
    rig.gate.step(rig.now_us);
  }
  assert.equal(rig.gate.state, "HOLD");
  assert.equal(rig.gate.applied.linear_mps, 0);
});

test("each tick checks the age of the frame again", () => {
  const rig = new Rig();
  rig.arm();
  rig.drive(60);
  const old = rig.frame();
  rig.pass(250_000);
  assert.equal(rig.command(old), null);
  rig.gate.step(rig.now_us);
  assert.equal(rig.gate.state, "DEGRADED");
  assert.equal(ageFactor(LIMITS, 150_000), 1);
  assert.equal(ageFactor(LIMITS, 275_000), 0.5);
  assert.equal(ageFactor(LIMITS, 400_000), 0);
});

test("a higher rank takes the lease, an equal rank is rejected", () => {
  const rig = new Rig();
  rig.arm();
  assert.equal(rig.command(rig.frame(), { session: "99999999", seq: 1 }), "NOT_HOLDER");
  assert.equal(rig.command(rig.frame(), { source: "teleop", session: "bbbbbbbb" }), null);
  assert.equal(rig.command(rig.frame()), "NOT_HOLDER");
});

test("the loss of a human driver disarms, and vision does not continue", () => {
  const rig = new Rig({ autoArm: true });
  const human = { source: "teleop", session: "bbbbbbbb" };
  rig.arm(human);
  rig.drive(20, human);
  rig.pass(1_000_000);
  assert.equal(rig.command(rig.frame()), "DISARMED");
  for (let count = 0; count < 20; count += 1) {
    rig.pass(TICK_US);
    assert.equal(rig.command(rig.frame()), "DISARMED");
    rig.gate.step(rig.now_us);
  }
});

test("STOP is latched, no older status permits a reset, and reset does not arm", () => {
  const rig = new Rig();
  rig.arm();
  rig.drive(60);
  const before = rig.frame("status");
  rig.pass(1);
  assert.equal(rig.gate.request({ source: "x", session: "aaaaaaaa", echo: null }, "stop", rig.now_us), "STOPPED");
  assert.equal(rig.command(rig.frame()), "STOPPED");
  rejects("STALE", () => rig.request("reset", { echo: before }));
  rejects("NOT_ALLOWED", () => rig.request("reset"));
  rig.stepUntil("STOPPED", 400_000);
  rejects("STOPPED", () => rig.request("arm"));
  assert.match(rig.request("reset"), /^reset/);
  assert.equal(rig.gate.state, "DISARMED");
  assert.equal(rig.command(rig.frame()), "DISARMED");
});

test("the latch survives a restart, also with auto_arm", () => {
  const rig = new Rig({ autoArm: true }, true);
  for (let count = 0; count < 10; count += 1) {
    rig.pass(TICK_US);
    assert.equal(rig.command(rig.frame()), "STOPPED");
    rig.gate.step(rig.now_us);
  }
  assert.equal(rig.gate.state, "STOPPED");
});

test("a request that permits motion must cite a status of at most 2 s", () => {
  const rig = new Rig();
  rejects("MALFORMED", () => rig.request("arm", { echo: null }));
  rejects("MALFORMED", () => rig.request("arm", { echo: rig.frame() }));
  const echo = rig.frame("status");
  rig.pass(2_000_001);
  rejects("STALE", () => rig.request("acquire", { source: "teleop", echo }));
});

test("acquire takes the lease, release returns it", () => {
  const rig = new Rig();
  const human = { source: "teleop", session: "bbbbbbbb" };
  assert.equal(rig.request("acquire", human), "acquired");
  assert.equal(rig.request("acquire", human), "already held");
  rejects("NOT_HOLDER", () => rig.request("acquire", { source: "vision" }));
  rejects("NOT_ALLOWED", () => rig.request("arm"));
  assert.equal(rig.request("release", { ...human, echo: null }), "released");
  assert.equal(rig.request("release", { ...human, echo: null }), "not held");
});

test("a twist over the limits is scaled by one factor and counted", () => {
  assert.deepEqual(clampTwist({ linear_mps: 1, angular_rad_s: 1 }, 0.5, 2), { linear_mps: 0.5, angular_rad_s: 0.5 });
  const rig = new Rig();
  rig.arm();
  assert.equal(rig.command(rig.frame(), { twist: { linear_mps: 48, angular_rad_s: 48 } }), null);
  assert.equal(rig.gate.counters.CLAMPED, 1);
});

test("the ramp depends on the elapsed time and does not overshoot", () => {
  const [often, seldom] = [new Ramp(LIMITS), new Ramp(LIMITS)];
  for (let count = 0; count < 10; count += 1) often.step(FORWARD, 10_000);
  seldom.step(FORWARD, 100_000);
  assert.ok(Math.abs(often.twist.linear_mps - 0.2) < 1e-9);
  assert.ok(Math.abs(seldom.twist.linear_mps - 0.2) < 1e-9);
  assert.equal(seldom.step(FORWARD, 900_000).linear_mps, 0.4);
});

test("a copied identity does not drive and does not block the driver", () => {
  const rig = new Rig();
  const chain = new ProofChain();
  for (let count = 0; count < 5; count += 1) rig.command(rig.frame(), chain.next());
  assert.equal(rig.request("arm"), "armed");
  assert.equal(rig.command(rig.frame(), { proof: "ab".repeat(16), seq: 9_000 }), "NOT_PROVEN");
  assert.equal(rig.command(rig.frame(), { seq: 9_000 }), "NOT_PROVEN");
  assert.equal(rig.command(rig.frame(), chain.next()), null);
});
