/** @file Ties the viewer to the elements of viewer.html. Shell. */

import { Viewer, canvasLook, markTarget } from "./viewer.mjs";

const part = (id) => document.getElementById(id);
const write = (id, text) => {
  part(id).textContent = text;
};

/** @param {object} what one thing that changed */
function show({ link, status, reply, stop, target }) {
  if (link !== undefined) write("link", link);
  if (status !== undefined) {
    write("state", status.state);
    const [linear, angular] = status.applied;
    write("reason", `${status.reason}; ${linear.toFixed(2)} m/s, ${angular.toFixed(2)} rad/s; driver: ${status.holder?.source ?? "nobody"}`);
  }
  if (reply !== undefined) write("news", reply.detail);
  if (stop !== undefined) write("news", stop);
  if (target !== undefined) markTarget(part("picture"), target);
}

const url = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/`;
const token = location.hash.slice(1); // what stands behind the # is never sent with a request
const viewer = new Viewer({ url, robot: document.body.dataset.robot, token, look: canvasLook(part("picture")), show });
viewer.open();

part("stop").onclick = () => viewer.stop();
document.addEventListener("keydown", (event) => {
  if (event.code !== "Space") return;
  event.preventDefault(); // or it would press the button that has the focus
  viewer.stop();
});
part("drive").onchange = ({ target }) => viewer.setDriving(target.checked);
for (const verb of ["arm", "disarm", "reset"]) part(verb).onclick = () => viewer.ask(verb);
