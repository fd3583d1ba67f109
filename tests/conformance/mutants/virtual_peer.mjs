/**
 * @file Run the pure parts of the JavaScript peers in virtual time: one JSON line in, one JSON line out. Shell (stdin, stdout).
 *
 *     node virtual_peer.mjs          {"do": "robot"|"vision", "folder", "now_us", ...}  a new peer from the modules of `folder`
 *                                    {"do": "message", "now_us", "channel", "source", "header", "payload"}     bytes in base64
 *                                    {"do": "tick", "now_us", "wanted"}  ->  {"out": [[channel, source, header, payload], ...]}
 *
 * It replaces `robot_server.mjs` and `vision_client.mjs`; the caller provides clock, camera and link.
 */

import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

const COMPUTE_US = 2_000; // simulated time to decode an image

const bytes = (text) => new Uint8Array(Buffer.from(text, "base64"));
const base64 = (data) => Buffer.from(data).toString("base64");

async function makeRobot({ load, session, jpeg, camera, limits, now_us }) {
  const [{ Robot }, { CHANNELS, encode }, { TICK_US }] = await load("robot", "codec", "limits");
  const robot = new Robot({ session, fps: 30, camera, limits });
  const image = bytes(jpeg);
  const written = ({ name, header, payload }) => [name, "", base64(encode(header)), base64(payload)];
  let [nextTick_us, nextCapture_us] = [now_us, now_us];

  const captured = (at_us, wanted) => {
    if (at_us < nextCapture_us) return [];
    nextCapture_us += robot.stream.interval_us;
    const frame = wanted && robot.mayCapture(at_us) ? robot.onImage(image, at_us, at_us) : null;
    return frame === null ? [] : [frame];
  };

  return {
    message({ now_us: at_us, channel, source, header, payload }) {
      robot.onMessage({ channel: CHANNELS[channel], source, header: bytes(header), payload: bytes(payload) }, at_us);
      return robot.takeReplies(at_us).map(written);
    },
    tick({ now_us: at_us, wanted }) {
      const due = at_us >= nextTick_us ? robot.tick(at_us) : [];
      if (at_us >= nextTick_us) nextTick_us = at_us + TICK_US;
      return [...due, ...captured(at_us, wanted)].map(written);
    },
  };
}

async function makeVision({ load, session }) {
  const [{ FrameLoop }, { Vision }, { CHANNELS, encode }, { decodeDc }] = await load("frame_loop", "vision", "codec", "jpeg_dc");
  let [clock_us, out, waiting] = [0, [], []];
  const decodeImage = (jpeg) => {
    clock_us += COMPUTE_US;
    const { width, height, scale, rgb } = decodeDc(jpeg);
    return { width, height, scale, data: rgb, channels: 3 };
  };
  const send = (name, header, payload) => out.push([name, header.source, base64(encode(header)), base64(payload)]);
  const pause = () => new Promise((resume) => waiting.push(resume)); // ends after all received messages are read
  const loop = new FrameLoop(new Vision(session), { decodeImage, send, now_us: () => clock_us, pause });
  const working = [];

  return {
    message({ now_us, channel, source, header, payload }) {
      clock_us = now_us;
      working.push(loop.onMessage({ channel: CHANNELS[channel], source, header: bytes(header), payload: bytes(payload) }));
      return [];
    },
    async tick({ now_us }) {
      clock_us = now_us;
      for (const resume of waiting.splice(0)) resume();
      await Promise.all(working.splice(0));
      return out.splice(0);
    },
  };
}

const MAKERS = { robot: makeRobot, vision: makeVision };
let peer = null;

async function answerTo(line) {
  const fields = JSON.parse(line);
  if (peer !== null && fields.do in peer) return { out: await peer[fields.do](fields) };
  const load = (...names) => Promise.all(names.map((name) => import(pathToFileURL(`${fields.folder}/${name}.mjs`))));
  peer = await MAKERS[fields.do]({ ...fields, load });
  return { out: [] };
}

for await (const line of createInterface({ input: process.stdin })) {
  let answer;
  try {
    answer = await answerTo(line);
  } catch (error) {
    answer = { error: String(error?.message ?? error).split("\n")[0] };
  }
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
