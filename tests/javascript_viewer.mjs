/**
 * Run the viewer without a screen, with the WebSocket of Node: watch, steer, send STOP. Arguments: URL, robot.
 *
 *     node --experimental-websocket tests/javascript_viewer.mjs ws://127.0.0.1:9090 r1
 */

import { decodeDc } from "../examples/js/jpeg_dc.mjs";
import { Viewer } from "../examples/js/viewer.mjs";

const printed = new Set();
let drawn = 0;

function print(line) {
  if (!printed.has(line)) console.log(line);
  printed.add(line);
}

function show({ link, status, reply, stop, target }) {
  if (link !== undefined) print(`link: ${link}`);
  if (reply !== undefined) print(`reply: ${reply.detail}`);
  if (target !== undefined) print(target === null ? "no target" : "target");
  if (stop === "STOPPED") finish();
  if (status?.state === "ACTIVE" && Math.abs(status.applied[0]) > 0.05) {
    print("driving");
    viewer.stop();
  }
}

function finish() {
  print(`stopped; frames: ${drawn > 10 ? "many" : drawn}; skipped: ${JSON.stringify(viewer.frameLoop.skipped)}`);
  viewer.close();
  setTimeout(() => process.exit(0), 200);
}

const decodeImage = async (jpeg) => {
  const { width, height, scale, rgb } = decodeDc(jpeg);
  drawn += 1;
  if (drawn === 10) viewer.setDriving(true); // watches only until then
  return { width, height, scale, data: rgb, channels: 3 };
};
const [url, robot] = process.argv.slice(2);
const viewer = new Viewer({ url, robot, decodeImage, show });
viewer.open();
