/** @file Tests of proof chains and digests. */

import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import test from "node:test";
import { Gate } from "./gate.mjs";
import { ProofChain, continues, sessionDigest, sha256 } from "./proof.mjs";

test("SHA-256 equals that of Node, and a renewed chain continues only with unrevealed elements", () => {
  for (const text of ["", "abc", "x".repeat(55)]) {
    assert.equal(Buffer.from(sha256(Buffer.from(text))).toString("hex"), createHash("sha256").update(text).digest("hex"));
  }
  const chain = new ProofChain();
  let last = chain.next();
  for (let count = 0; count < 2_500; count += 1) {
    const next = chain.next();
    assert.ok(continues(next.proof, last));
    assert.ok(!continues(last.proof, last) && !continues(last.next_proof ?? null, last));
    last = next;
  }
  assert.equal(sessionDigest("vision", "0000bbbb"), "20500bbc");
});

test("a robot with keys rejects a command and an acquire without a proof; arm and stop need none", () => {
  const [gate, session, now_us] = [new Gate("0a1b2c3d", { needsProof: true }), "4e5f6071", 1_000_000];
  const cited = (channel) => {
    gate.issued.add(channel, 1, now_us);
    return { channel, session: "0a1b2c3d", seq: 1, t_us: now_us };
  };
  const sends = (seq, proof) => gate.offer("vision", { source: "vision", session, seq, echo: cited("frame"), ...proof }, { linear_mps: 0.1, angular_rad_s: 0 }, now_us);
  const requests = (verb) => gate.request({ source: "teleop", session, echo: cited("status") }, verb, now_us);
  assert.equal(sends(1, {}), "NOT_PROVEN");
  assert.throws(() => requests("acquire"), (error) => error.reason === "NOT_PROVEN");
  assert.equal(sends(2, { proof: "0".repeat(32) }), "DISARMED");
  assert.throws(() => requests("arm"), (error) => error.reason === "NOT_ALLOWED");
  assert.equal(requests("stop"), "STOPPED");
});
