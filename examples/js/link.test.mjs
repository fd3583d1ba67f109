/** @file Tests of RFC 6455 frames, `sightline.v1`, credit, and the robot with the frame loop. */

import assert from "node:assert/strict";
import test from "node:test";
import { AnswerHeader } from "./fields.mjs";
import { CHANNELS, decode, encode } from "./codec.mjs";
import { FrameLoop } from "./frame_loop.mjs";
import { OutgoingQueue, PeerError, helloText, messageBound, pack, packRaw, readHello, unpack } from "./framing.mjs";
import { FrameReader, OPCODE, closePayload, encodeFrame } from "./rfc6455.mjs";
import { Robot } from "./robot.mjs";
import { Stream } from "./stream.mjs";
import { Vision, findTarget } from "./vision.mjs";
import { DRAWN_CAMERA, ballAt, drawJpeg } from "./drawing.mjs";
import { decodeDc } from "./jpeg_dc.mjs";
import { admissionProblem } from "./websocket.mjs";

const bytes = (text) => new TextEncoder().encode(text);
const text = (data) => new TextDecoder().decode(data);
const MASK = Uint8Array.from([1, 2, 3, 250]);
const closes = (code, act) => assert.throws(act, (error) => error instanceof PeerError && error.code === code);
const decoded = (jpeg, image = decodeDc(jpeg)) => ({ ...image, data: image.rgb, channels: 3 });
const server = (maxBytes = 1024) => new FrameReader({ masked: true, maxBytes });

for (const size of [0, 1, 125, 126, 127, 65_535, 65_536]) {
  test(`a frame of ${size} bytes is decoded, whole and byte by byte`, () => {
    const data = new Uint8Array(size).map((_, index) => index % 251);
    const frame = encodeFrame(OPCODE.BINARY, data, MASK);
    assert.deepEqual([...server(70_000).feed(frame)], [{ kind: "binary", data }]);
    if (size > 1000) return;
    const reader = server();
    const events = [...frame].flatMap((byte) => [...reader.feed(Uint8Array.of(byte))]);
    assert.deepEqual(events, [{ kind: "binary", data }]);
  });
}

test("a message in fragments with a ping between them is assembled", () => {
  const parts = [encodeFrame(OPCODE.TEXT, bytes("hé").subarray(0, 2), MASK), encodeFrame(OPCODE.PING, bytes("p"), MASK), encodeFrame(OPCODE.CONTINUATION, bytes("hé").subarray(2), MASK)];
  parts[0][0] &= 0x7f; // not final
  const events = [...server().feed(Uint8Array.from(parts.flatMap((part) => [...part])))];
  assert.deepEqual(events, [{ kind: "ping", data: bytes("p") }, { kind: "text", data: "hé" }]);
});

const changed = (frame, index, value) => frame.map((byte, at) => (at === index ? value : byte));
const EMPTY_TEXT = encodeFrame(OPCODE.TEXT, new Uint8Array(0), MASK);
const BROKEN = [
  ["a reserved bit", changed(EMPTY_TEXT, 0, 0xc1), 1002],
  ["an unknown opcode", changed(EMPTY_TEXT, 0, 0x83), 1002],
  ["no mask from a client", encodeFrame(OPCODE.TEXT, bytes("x")), 1002],
  ["a continuation without a message", encodeFrame(OPCODE.CONTINUATION, bytes("x"), MASK), 1002],
  ["a ping in fragments", changed(encodeFrame(OPCODE.PING, bytes("x"), MASK), 0, 0x09), 1002],
  ["a ping of 126 bytes", encodeFrame(OPCODE.PING, new Uint8Array(126), MASK), 1002],
  ["text that is not UTF-8", encodeFrame(OPCODE.TEXT, Uint8Array.of(0xff), MASK), 1007],
  ["a message over the limit", encodeFrame(OPCODE.BINARY, new Uint8Array(1025), MASK), 1009],
  ["the head of a message of 2^60 bytes", Uint8Array.of(0x82, 0xff, 0x10, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3, 4), 1009],
  ["a close code of one byte", encodeFrame(OPCODE.CLOSE, Uint8Array.of(3), MASK), 1002],
  ["an invalid close code", encodeFrame(OPCODE.CLOSE, closePayload(1005, ""), MASK), 1002],
];
for (const [name, frame, code] of BROKEN) {
  test(`${name} ends the connection with ${code}`, () => closes(code, () => [...server().feed(frame)]));
}

test("many small fragments have the size limit of one message", () => {
  const part = encodeFrame(OPCODE.CONTINUATION, new Uint8Array(10), MASK);
  part[0] &= 0x7f;
  const reader = server(1024);
  const first = encodeFrame(OPCODE.BINARY, new Uint8Array(10), MASK);
  first[0] &= 0x7f;
  closes(1009, () => {
    [...reader.feed(first)];
    for (let count = 0; count < 200; count += 1) [...reader.feed(part)];
  });
});

test("a close reason is cut between characters", () => {
  assert.ok(closePayload(1008, "é".repeat(100)).length <= 125);
  assert.equal(text(closePayload(1008, "é".repeat(100)).subarray(2)), "é".repeat(61));
});

test("a hello is read; another robot, another version and an invalid text end with 1008", () => {
  const hello = readHello(helloText("r1", "0a1b2c3d", ["frame", "later"], "vision"), "r1");
  assert.deepEqual(hello, { v: 1, robot: "r1", role: "vision", session: "0a1b2c3d", wants: ["frame", "later"] });
  closes(1008, () => readHello(helloText("r2", "0a1b2c3d", []), "r1"));
  closes(1008, () => readHello('{"v":2,"robot":"r1","session":"0a1b2c3d"}', "r1"));
  closes(1008, () => readHello("0.2|0.1", "r1"));
});

const ECHO = { channel: "frame", session: "0a1b2c3d", seq: 41, t_us: 1_500_000 };
const HEADER = { v: 1, source: "vision", session: "4e5f6071", seq: 7, echo: ECHO, compute_us: 2300 };
const message = (block, payload = "0|0") => Uint8Array.from([block.length >> 8, block.length & 255, ...bytes(block), ...bytes(payload)]);

test("a packed message is unpacked", () => {
  const packet = unpack(pack("twist", HEADER, bytes("0|0")), "", "r1");
  assert.deepEqual([packet.channel.name, packet.source, text(packet.payload)], ["twist", "vision", "0|0"]);
  assert.deepEqual(decode(AnswerHeader, packet.header), { ...HEADER, scan: null, mission: null, proof: null, next_proof: null });
});

test("the channel may be any field, and the role of the hello replaces a missing source", () => {
  const packet = unpack(message('{"seq":1, "channel" : "ack"}', ""), "viewer", "r1");
  assert.deepEqual([packet.channel.name, packet.source], ["ack", "viewer"]);
});

test("a message without a header is empty, and bytes after the names are the header", () => {
  assert.equal(unpack(message('{"channel":"twist","source":"guest"}'), "", "r1").header.length, 0);
  assert.equal(text(unpack(message('{"channel":"twist","source":"guest"}[1]'), "", "r1").header), "[1]");
});

test("an invalid key is dropped, an invalid block ends the connection", () => {
  assert.equal(unpack(message('{"channel":"nonsense"}'), "vision", "r1"), null);
  assert.equal(unpack(message('{"channel":"twist","source":"Vision"}'), "", "r1"), null);
  for (const block of ["", "{}", "[]", '{"channel":1}', "\u0001"]) closes(1007, () => unpack(message(block), "vision", "r1"));
  closes(1007, () => unpack(Uint8Array.of(0, 9, 123), "vision", "r1"));
  closes(1007, () => unpack(new Uint8Array(700).fill(0x20).map((byte, at) => (at === 0 ? 2 : at === 1 ? 65 : byte)), "", "r1"));
});

test("the wanted channels limit the message size", () => {
  assert.equal(messageBound(["twist", "ack", "request"]), 1024);
  assert.equal(messageBound(["twist", "detections"]), 2 + 576 + 32_768);
  assert.equal(messageBound(["frame", "status"]), 2 + 576 + CHANNELS.frame.maxPayloadBytes);
});

test("the queue keeps the newest message per channel and source, and the most urgent leaves first", () => {
  const queue = new OutgoingQueue();
  queue.put("frame", "", "old");
  queue.put("frame", "", "new");
  queue.put("ack", "a", "ack");
  queue.put("", "", "hello");
  assert.deepEqual([queue.take(), queue.take(), queue.take(), queue.take()], ["hello", "ack", "new", undefined]);
  assert.equal(queue.dropped, 1);
});

test("the queue keeps one request per verb, and STOP leaves first", () => {
  const queue = new OutgoingQueue();
  for (const verb of ["arm", "stop", "arm", "stop", "disarm"]) queue.put("request", "operator", verb, verb);
  assert.deepEqual([queue.take(), queue.take(), queue.take(), queue.take()], ["stop", "arm", "disarm", undefined]);
  queue.put("", "", "hello");
  queue.put("request", "operator", "stop", "stop");
  assert.deepEqual([queue.take(), queue.take()], ["hello", "stop"]);
});

test("unknown sources have few places in the queue and displace no role", () => {
  const queue = new OutgoingQueue();
  for (let number = 0; number < 1000; number += 1) queue.put("detections", `s${number}`, "old");
  for (const source of ["vision", "detector", "s0"]) queue.put("detections", source, "new");
  for (let number = 0; number < 20; number += 1) queue.put("request", `s${number}`, "stop");
  const taken = [];
  for (let message = queue.take(); message !== undefined; message = queue.take()) taken.push(message);
  assert.deepEqual(taken.slice(0, 20), Array(20).fill("stop"));
  assert.equal(taken.filter((message) => message === "old").length, 15);
  assert.equal(taken.filter((message) => message === "new").length, 3);
  assert.equal(queue.dropped, 1000 - 16 + 1);
});

const ADMITTED = [
  [["Host", "127.0.0.1:9090"], true],
  [["Host", "[::1]:9090"], true],
  [["Host", "robot.local:9090", "Origin", "http://robot.local:9090"], true],
  [["Host", "robot"], true],
  [["Host", "evil.example"], false],
  [["Host", "127.0.0.1", "Host", "127.0.0.1"], false],
  [[], false],
  [["Host", "127.0.0.1:9090", "Origin", "http://evil.example"], false],
  [["Host", "127.0.0.1:9090", "Origin", "null"], false],
];
for (const [headers, admitted] of ADMITTED) {
  test(`${headers.join(" ")} is ${admitted ? "admitted" : "rejected"}`, () => {
    assert.equal(admissionProblem(headers, "127.0.0.1") === null, admitted);
  });
}

const SENDER = { source: "vision", session: "4e5f6071" };

test("one frame is in flight, and its credit returns with the answer or after 120 ms", () => {
  const stream = new Stream(30);
  assert.ok(stream.mayCapture(0));
  stream.onSent(0, 0, 0);
  assert.ok(!stream.mayCapture(100_000));
  stream.onAnswer(SENDER, 0, 0, 5_000);
  assert.ok(stream.mayCapture(100_000));
  stream.onSent(1, 100_000, 100_000);
  assert.ok(stream.mayCapture(300_000));
  assert.equal(stream.status(300_000).credit_timeouts, 1);
});

test("the window grows with the delay of the link, not with computing time", () => {
  const [slowLink, slowPeer] = [new Stream(30), new Stream(30)];
  for (let seq = 0; seq < 20; seq += 1) {
    slowLink.onSent(seq, seq * 100_000, seq * 100_000);
    slowPeer.onSent(seq, seq * 100_000, seq * 100_000);
    slowLink.onAnswer(SENDER, seq, 0, seq * 100_000 + 70_000);
    slowPeer.onAnswer(SENDER, seq, 69_000, seq * 100_000 + 70_000);
  }
  assert.equal(slowLink.window, 3);
  assert.equal(slowPeer.window, 1);
});

test("only answers of the driver return credit", () => {
  const stream = new Stream(30);
  stream.onHolder(SENDER, 0);
  stream.onSent(0, 0, 0);
  stream.onAnswer({ source: "viewer", session: "99999999" }, 0, 0, 1000);
  assert.ok(!stream.mayCapture(50_000));
});

test("the frame loop finds the drawn ball and drives the robot", async () => {
  let now_us = 1_000_000;
  const robot = new Robot({ session: "0a1b2c3d", fps: 30, camera: DRAWN_CAMERA, limits: { autoArm: true } });
  const loop = new FrameLoop(new Vision("4e5f6071"), {
    decodeImage: decoded,
    send: (name, header, payload) => robot.onMessage(unpack(pack(name, header, payload), "vision", "js1"), now_us),
    now_us: () => now_us,
  });
  for (let count = 0; count < 60; count += 1, now_us += 33_333) {
    for (const { name, header, payload } of robot.tick(now_us)) await loop.onMessage(unpack(pack(name, header, payload), "", "js1"));
    assert.ok(robot.mayCapture(now_us), `credit at ${count}`);
    const frame = robot.onImage(drawJpeg(robot.pose, { x_m: 1.5, y_m: 0.5 }), now_us, now_us);
    await loop.onMessage(unpack(pack(frame.name, frame.header, frame.payload), "", "js1"));
  }
  assert.equal(loop.answered, 60);
  assert.deepEqual(loop.vision.camera.width_px, 640);
  assert.equal(robot.gate.state, "ACTIVE");
  assert.ok(robot.pose.yaw_rad > 0.1 && robot.pose.x_m > 0.1, JSON.stringify(robot.pose));
});

test("an invalid image is acknowledged, and a newer frame replaces a waiting one", async () => {
  const sent = [];
  let release;
  const decodeImage = () => new Promise((resolve) => (release = () => resolve({ width: 1, height: 1, scale: 8, data: [0, 0, 0], channels: 3 })));
  const loop = new FrameLoop(new Vision("4e5f6071"), { decodeImage, send: (name, header) => sent.push([name, header.echo.seq]), now_us: () => 0 });
  const frame = (seq, jpeg) => ({ channel: CHANNELS.frame, source: "", header: encode({ v: 1, session: "0a1b2c3d", seq, t_us: seq }), payload: jpeg });
  await loop.onMessage(frame(1, bytes("not a JPEG")));
  assert.deepEqual(sent, [["ack", 1]]);
  const good = drawJpeg({ x_m: 0, y_m: 0, yaw_rad: 0 }, { x_m: 1, y_m: 0 });
  loop.vision.onCamera({ session: "0a1b2c3d" }, DRAWN_CAMERA);
  const working = loop.onMessage(frame(2, good));
  await Promise.resolve();
  for (const seq of [3, 4]) loop.onMessage(frame(seq, good));
  loop.onMessage(frame(3, good));
  for (let turn = 0; turn < 2; turn += 1) {
    release();
    for (let wait = 0; wait < 5; wait += 1) await Promise.resolve();
  }
  await working;
  assert.deepEqual(sent.map(([, seq]) => seq), [1, 2, 4]);
  assert.equal(loop.skipped.OUT_OF_ORDER, 1);
});

test("the drawn ball is visible from the start pose at any time", () => {
  for (let t_us = 0; t_us < 40e6; t_us += 700e3) {
    assert.ok(findTarget(decoded(drawJpeg({ x_m: 0, y_m: 0, yaw_rad: 0 }, ballAt(t_us)))), `after ${t_us / 1e6} s`);
  }
});

test("a JPEG cut anywhere is rejected", () => {
  const good = drawJpeg({ x_m: 0, y_m: 0, yaw_rad: 0 }, { x_m: 1, y_m: 0 });
  assert.deepEqual([decodeDc(good).width, decodeDc(good).height], [80, 60]);
  for (let end = 0; end < good.length - 4; end += 7) assert.throws(() => decodeDc(good.subarray(0, end)), /image/);
});

test("detections are forwarded unchanged and do not drive", () => {
  const robot = new Robot({ session: "0a1b2c3d", fps: 30, camera: DRAWN_CAMERA });
  const [found, header] = ['{"width_px":640,"height_px":480,"boxes":[]}', '{"source":"guest", "session":"4e5f6071","seq":1}'].map((one) => bytes(one));
  const packet = { channel: CHANNELS.detections, source: "guest", header, payload: found };
  for (const [changes, isTaken] of [[{}, true], [{ source: "other" }, false], [{ payload: bytes("{}") }, false]]) assert.equal(robot.onMessage({ ...packet, ...changes }, 0), isTaken);
  for (const came of [header, bytes(` ${text(header)}`), bytes("{")]) {
    const again = unpack(packRaw("detections", "guest", came, found), "", "r1");
    assert.deepEqual([again.source, text(again.header), text(again.payload)], ["guest", text(came), text(found)]);
  }
  assert.equal(JSON.parse(text(packRaw("detections", "guest", header, bytes("")).subarray(2))).session, "4e5f6071");
  assert.deepEqual(robot.gate.counters, {});
});

test("a live camera whose image does not change makes commands stale", () => {
  const robot = new Robot({ session: "0a1b2c3d", fps: 30, camera: DRAWN_CAMERA, live: true });
  const jpeg = drawJpeg({ x_m: 0, y_m: 0, yaw_rad: 0 }, { x_m: 1, y_m: 0 });
  const answers = [0, 200_000, 400_000, 400_001].map((t_us) => {
    const { header } = robot.onImage(jpeg, 1_000_000 + t_us, 1_000_000 + t_us);
    const echo = { channel: "frame", session: header.session, seq: header.seq, t_us: header.t_us };
    return robot.gate.offer("vision", { ...HEADER, seq: header.seq + 1, echo }, { linear_mps: 0.1, angular_rad_s: 0 }, header.t_us);
  });
  assert.deepEqual(answers, ["DISARMED", "DISARMED", "DISARMED", "STALE"]);
});

test("a new session of the robot discards the state of the old one", () => {
  const vision = new Vision("4e5f6071");
  vision.onCamera({ session: "0a1b2c3d" }, DRAWN_CAMERA);
  assert.ok(vision.isNew({ session: "0a1b2c3d", seq: 9 }));
  assert.ok(!vision.isNew({ session: "0a1b2c3d", seq: 9 }));
  assert.equal(vision.twistFor(null).linear_mps, 0);
  assert.ok(vision.isNew({ session: "ffffffff", seq: 0 }));
  assert.equal(vision.twistFor(null), null);
});

test("the answer times of one owner do not apply to the next", () => {
  const stream = new Stream(30);
  stream.onSent(0, 0, 0);
  stream.onAnswer(SENDER, 0, 0, 2000);
  assert.equal(stream.timeout_us, 15_000);
  stream.onAnswer({ source: "viewer", session: "99999999" }, 0, 0, 1_500_000);
  assert.equal(stream.timeout_us, 120_000);
});
