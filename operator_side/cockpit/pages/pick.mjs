/** @file Picks a color in a robot's live pictures, which stand still from the first touch on, or in those of a file. Shell. */

const CLICK_PX = 4; // on the screen: a smaller box was meant as a click
const RETRY_MS = 500;
const part = (id) => document.getElementById(id);
const canvas = part("picture");
const live = document.body.dataset.live === "true";
let number = 0; // of the picture that is shown
let last = 0; // number of the picture that came last, drawn or not
let held = false; // live pictures stand still
let from = null; // where a box was begun
let picks = 0;

const pause = (time_ms) => new Promise((resolve) => setTimeout(resolve, time_ms));
const write = (id, text) => {
  part(id).textContent = text ?? "";
};

async function draw(answer) {
  const bitmap = await createImageBitmap(await answer.blob());
  if (held) return;
  Object.assign(canvas, { width: bitmap.width, height: bitmap.height });
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
  number = Number(answer.headers.get("X-Number"));
}

async function showLive() {
  for (;;) {
    if (held) {
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
  Object.assign(part("pictures"), { max: count, value: number });
  part("pictures").style.display = count > 1 ? "block" : "none";
}

function place(event) {
  const area = canvas.getBoundingClientRect();
  const within = (value, most) => Math.max(0, Math.min(most - 1, Math.floor(value)));
  return {
    x: within(((event.clientX - area.left) / area.width) * canvas.width, canvas.width),
    y: within(((event.clientY - area.top) / area.height) * canvas.height, canvas.height),
    screenX: event.clientX - area.left, screenY: event.clientY - area.top,
  };
}

function showBox(to) {
  const [left, top] = [Math.min(from.screenX, to.screenX), Math.min(from.screenY, to.screenY)];
  const [width, height] = [Math.abs(from.screenX - to.screenX), Math.abs(from.screenY - to.screenY)];
  Object.assign(part("box").style, { display: "block", left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
}

async function pick(to) {
  const isClick = Math.hypot(to.screenX - from.screenX, to.screenY - from.screenY) < CLICK_PX;
  const [x_px, y_px] = [Math.min(from.x, to.x), Math.min(from.y, to.y)];
  const [width_px, height_px] = isClick ? [0, 0] : [Math.abs(from.x - to.x) + 1, Math.abs(from.y - to.y) + 1];
  const request = { number, x_px: isClick ? to.x : x_px, y_px: isClick ? to.y : y_px, width_px, height_px };
  await show(await post("pick", request));
}

async function post(what, value) {
  const request = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(value) };
  try {
    return await (await fetch(what, request)).json();
  } catch {
    return { error: "`sightline pick-color` has ended" };
  }
}

async function show({ error, ranges, trial, toml }) {
  write("error", error);
  write("ranges", ranges);
  write("trial", trial);
  write("toml", toml);
  part("use").disabled = error !== undefined;
  part("again").disabled = false;
  part("mask").style.display = ranges === undefined ? "none" : "block";
  if (ranges !== undefined) part("mask").src = `mask?pick=${(picks += 1)}`;
}

function again() {
  held = false;
  part("box").style.display = "none";
  part("mask").style.display = "none";
  for (const id of ["error", "ranges", "trial", "toml"]) write(id, "");
  for (const id of ["use", "again"]) part(id).disabled = true;
}

canvas.onpointerdown = (event) => {
  if (number === 0) return;
  held = true;
  from = place(event);
  canvas.setPointerCapture(event.pointerId);
  part("box").style.display = "none";
};
canvas.onpointermove = (event) => {
  if (from !== null) showBox(place(event));
};
canvas.onpointerup = async (event) => {
  if (from === null) return;
  const to = place(event);
  showBox(to);
  await pick(to);
  from = null;
};
part("again").onclick = again;
part("use").onclick = async () => {
  const { note, error } = await post("use", { toml: part("toml").textContent });
  write("note", note);
  write("error", error);
  if (note !== undefined) for (const id of ["use", "again"]) part(id).disabled = true;
};
part("pictures").oninput = ({ target }) => {
  again();
  showStill(target.value);
};
if (live) showLive();
else showStill(0);
