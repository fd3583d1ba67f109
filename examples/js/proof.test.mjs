/** @file Tests of proof chains and digests. */

import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import test from "node:test";
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
