/** @file Connect the viewer to the elements of viewer.html. Shell. */

import { Viewer, canvasDecoder, markTarget } from "./viewer.mjs";

const REFRESH_MS = 100;
const OLD_MS = 500; // an older image must not look current
const STATUS_MS = 1000; // ten periods of a status
const element = (id) => document.getElementById(id);
const write = (id, text) => {
  element(id).textContent = text;
};
const drawnAt_ms = []; // times of the images of the last second
let statusAt_ms = Infinity; // arrival of the status on the page; Infinity: the page shows no status
let messageState = null; // state that clears the message when it ends; null: the message stays until the next one
let newest_ms = 0; // lowest age of the newest image when it was drawn

/** Show a change. @param {object} change one of those of {@link Viewer} */
function show({ link, status, reply, stop, target, age_us }) {
  if (link !== undefined) {
    write("link", link);
    element("link").className = link === "connected" ? "" : "lost";
    if (link !== "connected") clearStatus("");
  }
  if (status !== undefined) showStatus(status);
  if (reply !== undefined) showMessage(reply.detail, reply.state);
  if (stop !== undefined) showMessage(stop, stop === "STOPPED" ? stop : null);
  if (target !== undefined) {
    drawnAt_ms.push(performance.now());
    newest_ms = age_us / 1000;
    markTarget(element("picture"), target);
  }
}

function showMessage(message, state) {
  messageState = state;
  write("message", message);
}

/** Clear the result of a request or STOP when the state that followed it ends. */
function clearMessage(state) {
  if (messageState !== null && state !== messageState) showMessage("", null);
}

function showStatus({ state, reason, holder, applied, frame_age_us, latency_us, stream }) {
  statusAt_ms = performance.now();
  clearMessage(state);
  write("state", state);
  element("state").className = state;
  write("reason", reason);
  const side = applied[1] < 0 ? "right" : "left";
  write("wheels", `${applied[0].toFixed(2)} m/s, turning ${side} at ${Math.abs(applied[1]).toFixed(2)} rad/s`);
  write("driver", holder === null ? "none" : holder.digest === viewer.vision.digest ? "this page" : `${holder.source} ${holder.digest}`);
  const age = frame_age_us === null ? [] : [`${Math.round(frame_age_us / 1000)} ms old`];
  const latency = latency_us === null ? [] : [`capture to command ${Math.round(latency_us / 1000)} ms`];
  write("frame_age", [...age, ...latency].join(", ") || "none");
  write("frames", `${stream.sent} sent, ${viewer.frameLoop.answered} answered by this page, ${stream.credit_timeouts} credit timeouts`);
}

/** Clear the status: an old one must not look current. */
function clearStatus(reason) {
  statusAt_ms = Infinity;
  clearMessage("?");
  for (const id of ["state", "wheels", "driver", "frame_age", "frames"]) write(id, "?");
  element("state").className = "";
  write("reason", reason);
}

function refresh() {
  showAge();
  if (performance.now() - statusAt_ms > STATUS_MS) clearStatus("no status for more than 1 s");
}

/** Show the age of the image. It grows while no image arrives, so that a frozen or late image is visible as one. */
function showAge() {
  const now_ms = performance.now();
  while (drawnAt_ms.length > 1 && drawnAt_ms[0] < now_ms - 1000) drawnAt_ms.shift();
  if (drawnAt_ms.length === 0) return;
  const since_ms = now_ms - drawnAt_ms.at(-1);
  const age_ms = since_ms + newest_ms;
  element("figure").className = age_ms > OLD_MS ? "old" : "";
  const images = `${drawnAt_ms.length} images/s, at least ${Math.round(age_ms)} ms old`;
  write("age", since_ms > OLD_MS ? `no image for ${(since_ms / 1000).toFixed(1)} s` : images);
}

const url = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/`;
const token = location.hash.slice(1); // a browser never sends the part after the #
globalThis.onhashchange = () => location.reload(); // a browser does not reload a page for a new token
const viewer = new Viewer({ url, robot: document.body.dataset.robot, token, decodeImage: canvasDecoder(element("picture")), show });
viewer.open();
setInterval(refresh, REFRESH_MS);
document.onvisibilitychange = document.onresume = refresh; // a hidden page has few timers, or none

element("stop").onclick = () => viewer.stop();
document.addEventListener("keydown", (event) => {
  if (event.code !== "Space") return;
  event.preventDefault(); // otherwise it presses the focused button
  viewer.stop();
});
element("drive").onchange = ({ target }) => viewer.setDriving(target.checked);
for (const verb of ["arm", "disarm", "reset"]) element(verb).onclick = () => viewer.request(verb);
