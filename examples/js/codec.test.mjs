/** @file Tests of the codec: every golden vector, and the places where JavaScript is lenient by default. */

import assert from "node:assert/strict";
import { readFileSync, readdirSync } from "node:fs";
import test from "node:test";
import { WireError, decode, encode, formatTwist, parseKey, parseTwist, readJpegSize } from "./codec.mjs";
import { answerTo } from "./codec_adapter.mjs";
import { AnswerHeader, Reply, Stamp } from "./fields.mjs";
import { Real, parseJson } from "./json.mjs";

const VECTORS = new URL("../../protocol/vectors/", import.meta.url);
const bytes = (text) => new TextEncoder().encode(text);
const hasReason = (reason) => (error) => error instanceof WireError && error.reason === reason;
const base64 = (hex) => Buffer.from(hex, "hex").toString("base64");

/** Return all vectors, but not those of the STOP port, which these peers do not have. */
function allVectors() {
  return readdirSync(VECTORS, { recursive: true })
    .filter((name) => name.endsWith(".json") && !name.startsWith("stop/"))
    .map((name) => ({ name, ...JSON.parse(readFileSync(new URL(name, VECTORS), "utf8")) }));
}

/** Return the vectors of whole messages, in folders named after channels. */
const vectors = () => allVectors().filter((vector) => vector.key !== undefined);

function question(vector) {
  if (vector.key === undefined) return { ...vector, kind: vector.name.split("/")[0] };
  return { kind: "message", key: vector.key, header: base64(vector.header_hex), payload: base64(vector.payload_hex) };
}

test("every golden vector has the stated result", () => {
  const all = allVectors();
  assert.ok(all.length >= 200, `${all.length} vectors`);
  for (const vector of all) {
    const expected = vector.refuse === undefined ? { ok: vector.accept } : { refusal: vector.refuse };
    const plain = (value) => JSON.parse(JSON.stringify(value)); // -0 is 0
    assert.deepEqual(plain(answerTo(question(vector))), plain(expected), vector.name);
  }
});

test("every vector cut at every byte is accepted or rejected with a reason", () => {
  for (const vector of vectors().filter((one) => one.header_hex.length < 1100 && one.payload_hex.length < 1100)) {
    for (const part of ["header_hex", "payload_hex"]) {
      for (let end = 0; end < vector[part].length; end += 2) {
        const cut = { ...vector, [part]: vector[part].slice(0, end) };
        const answer = answerTo(question(cut));
        assert.ok("ok" in answer || /^[A-Z_]+$/.test(answer.refusal), vector.name);
      }
    }
  }
});

test("an integer and a real stay distinct", () => {
  assert.deepEqual(parseJson('[1, -2, 1.0, 1e2]'), [1, -2, new Real(1), new Real(100)]);
});

for (const text of ["", "01", "1.", ".5", "+1", "[1,]", '{"a":1,}', "{'a':1}", '"\t"', '"\\x"', '"\\ud800"', "nul", "1 2", "NaN", "\ufeff1", "[".repeat(500)]) {
  test(`invalid JSON: ${JSON.stringify(text).slice(0, 20)}`, () => assert.throws(() => parseJson(text)));
}

test("the last of two equal fields counts, and __proto__ is an ordinary field", () => {
  const stamp = decode(Stamp, bytes('{"__proto__":{"seq":1},"session":"0a1b2c3d","seq":5,"seq":6,"t_us":0}'));
  assert.equal(stamp.seq, 6);
  assert.throws(() => decode(Stamp, bytes('{"__proto__":{"seq":1},"session":"0a1b2c3d","t_us":0}')), hasReason("MALFORMED"));
});

test("the version is checked before the other fields", () => {
  assert.throws(() => decode(AnswerHeader, bytes('{"v":2}')), hasReason("UNSUPPORTED_VERSION"));
  assert.throws(() => decode(AnswerHeader, bytes('{"v":true}')), hasReason("UNSUPPORTED_VERSION"));
});

test("the length of a text counts code points", () => {
  const reply = { to: "0a1b2c3d", id: 1, ok: true, state: "HOLD", detail: "\u{1f6d1}".repeat(200) };
  assert.equal(decode(Reply, encode(reply)).detail.length, 400);
  assert.throws(() => decode(Reply, encode({ ...reply, detail: "x".repeat(201) })), hasReason("MALFORMED"));
});

test("an encoded header decodes to the same header, without nulls on the wire", () => {
  const echo = { channel: "frame", session: "0a1b2c3d", seq: 1, t_us: 2 };
  const header = { v: 1, source: "vision", session: "4e5f6071", seq: 3, echo, compute_us: 4 };
  assert.deepEqual(decode(AnswerHeader, encode(header)), { ...header, scan: null, mission: null, proof: null, next_proof: null });
  assert.equal(new TextDecoder().decode(encode({ a: null, b: 0 })), '{"b":0}');
});

test("a twist has four decimals and never minus zero", () => {
  const written = (linear, angular) => new TextDecoder().decode(formatTwist({ linear_mps: linear, angular_rad_s: angular }));
  assert.equal(written(0.2, -0.35), "0.2000|-0.3500");
  assert.equal(written(-0, -0.00001), "0.0000|0.0000");
  assert.deepEqual(parseTwist(bytes(".5|5.")), { linear_mps: 0.5, angular_rad_s: 5 });
});

test("an inexact key is invalid", () => {
  for (const key of ["sightline/r1/constructor", "sightline/r1/twist", "sightline/r1/frame/x", "sightline//frame", "sightline/r1/__proto__"]) {
    assert.equal(parseKey(key), null, key);
  }
  assert.equal(parseKey("sightline/r1/ack/viewer").source, "viewer");
});

test("the limit of the image size is an option", () => {
  const gray = Uint8Array.from([0xff, 0xd8, 0xff, 0xc0, 0, 11, 8, 0, 48, 0, 64, 1, 1, 0x11, 0]);
  assert.deepEqual(readJpegSize(gray), { width_px: 64, height_px: 48, components: 1 });
  assert.throws(() => readJpegSize(gray, 64 * 48 - 1), hasReason("MALFORMED"));
});
