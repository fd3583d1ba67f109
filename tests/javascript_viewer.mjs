/**
 * The browser's viewer with the platform's own WebSocket and no screen: watches, steers, says STOP. Arguments: URL, robot.
 *
 *     node --experimental-websocket tests/javascript_viewer.mjs ws://127.0.0.1:9090 r1
 */

import { decodeDc } from "../examples/js/jpeg_dc.mjs";
import { Viewer } from "../examples/js/viewer.mjs";

const said = new Set();
let drawn = 0;

function say(line) {
  if (!said.has(line)) console.log(line);
  said.add(line);
}

function show({ link, status, reply, stop, target }) {
  if (link !== undefined) say(`link: ${link}`);
  if (reply !== undefined) say(`reply: ${reply.detail}`);
  if (target !== undefined) say(target === null ? "nothing" : "target");
  if (stop === "STOPPED") finish();
  if (status?.state === "ACTIVE" && Math.abs(status.applied[0]) > 0.05) {
    say("driving");
    viewer.stop();
  }
}

function finish() {
  say(`stopped; frames: ${drawn > 10 ? "many" : drawn}; skipped: ${JSON.stringify(viewer.eyes.skipped)}`);
  viewer.close();
  setTimeout(() => process.exit(0), 200);
}

const look = async (jpeg) => {
  const { width, height, scale, rgb } = decodeDc(jpeg);
  drawn += 1;
  if (drawn === 10) viewer.setDriving(true); // until then it only watches
  return { width, height, scale, data: rgb, channels: 3 };
};
const [url, robot] = process.argv.slice(2);
const viewer = new Viewer({ url, robot, look, show });
viewer.open();
