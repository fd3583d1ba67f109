/** @file Pick a color in the live images of a robot, which freeze at the first touch, or in the images of a file. Shell. */

const CLICK_PX = 4; // on the screen; a smaller box counts as a click
const RETRY_MS = 500;
const element = (id) => document.getElementById(id);
const canvas = element("picture");
const live = document.body.dataset.live === "true";
let number = 0; // of the image on the page
let last = 0; // number of the last received image, drawn or not
let isFrozen = false; // the page shows no further live image
let start = null; // first corner of the box
let picks = 0;

const pause = (time_ms) => new Promise((resolve) => setTimeout(resolve, time_ms));
const write = (id, text) => {
  element(id).textContent = text ?? "";
};

async function draw(answer) {
  const bitmap = await createImageBitmap(await answer.blob());
  if (isFrozen) return;
  Object.assign(canvas, { width: bitmap.width, height: bitmap.height });
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
  number = Number(answer.headers.get("X-Number"));
}

async function showLive() {
  for (;;) {
    if (isFrozen) {
      await pause(50);
      continue;
    }
    try {
      const answer = await fetch(`picture?after=${last}`);
      if (!answer.ok) throw new Error(`picture: ${answer.status}`);
      if (answer.status === 204) continue; // the server has waited for an image
      last = Number(answer.headers.get("X-Number"));
      await draw(answer);
    } catch {
      await pause(RETRY_MS);
    }
  }
}

async function showStill(wanted) {
  const answer = await fetch(wanted ? `picture?number=${wanted}` : "picture");
  await draw(answer);
  const count = answer.headers.get("X-Count");
  Object.assign(element("pictures"), { max: count, value: number });
  element("pictures").style.display = count > 1 ? "block" : "none";
}

function positionOf(event) {
  const area = canvas.getBoundingClientRect();
  const within = (value, most) => Math.max(0, Math.min(most - 1, Math.floor(value)));
  return {
    x: within(((event.clientX - area.left) / area.width) * canvas.width, canvas.width),
    y: within(((event.clientY - area.top) / area.height) * canvas.height, canvas.height),
    screenX: event.clientX - area.left, screenY: event.clientY - area.top,
  };
}

function showBox(to) {
  const [left, top] = [Math.min(start.screenX, to.screenX), Math.min(start.screenY, to.screenY)];
  const [width, height] = [Math.abs(start.screenX - to.screenX), Math.abs(start.screenY - to.screenY)];
  Object.assign(element("box").style, { display: "block", left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
}

async function pick(to) {
  const isClick = Math.hypot(to.screenX - start.screenX, to.screenY - start.screenY) < CLICK_PX;
  const [x_px, y_px] = [Math.min(start.x, to.x), Math.min(start.y, to.y)];
  const [width_px, height_px] = isClick ? [0, 0] : [Math.abs(start.x - to.x) + 1, Math.abs(start.y - to.y) + 1];
  const request = { number, x_px: isClick ? to.x : x_px, y_px: isClick ? to.y : y_px, width_px, height_px };
  await show(await post("pick", request));
}

async function post(route, value) {
  const request = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(value) };
  try {
    return await (await fetch(route, request)).json();
  } catch {
    return { error: "`sightline pick-color` has ended" };
  }
}

async function show({ error, ranges, trial, toml }) {
  write("error", error);
  write("ranges", ranges);
  write("trial", trial);
  write("toml", toml);
  element("use").disabled = error !== undefined;
  element("again").disabled = false;
  element("mask").style.display = ranges === undefined ? "none" : "block";
  if (ranges !== undefined) element("mask").src = `mask?pick=${(picks += 1)}`;
}

function pickAgain() {
  isFrozen = false;
  element("box").style.display = "none";
  element("mask").style.display = "none";
  for (const id of ["error", "ranges", "trial", "toml"]) write(id, "");
  for (const id of ["use", "again"]) element(id).disabled = true;
}

canvas.onpointerdown = (event) => {
  if (number === 0) return;
  isFrozen = true;
  start = positionOf(event);
  canvas.setPointerCapture(event.pointerId);
  element("box").style.display = "none";
};
canvas.onpointermove = (event) => {
  if (start !== null) showBox(positionOf(event));
};
canvas.onpointerup = async (event) => {
  if (start === null) return;
  const to = positionOf(event);
  showBox(to);
  await pick(to);
  start = null;
};
element("again").onclick = pickAgain;
element("use").onclick = async () => {
  const { note, error } = await post("use", { toml: element("toml").textContent });
  write("note", note);
  write("error", error);
  if (note !== undefined) for (const id of ["use", "again"]) element(id).disabled = true;
};
element("pictures").oninput = ({ target }) => {
  pickAgain();
  showStill(target.value);
};
if (live) showLive();
else showStill(0);
