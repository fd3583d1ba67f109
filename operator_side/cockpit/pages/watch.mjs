/**
 * @file Show the images and the state of one robot. Shell.
 *
 * The page requests the next image after it drew the last one, so that no queue grows between it and the vision service.
 */

const OLD_MS = 500; // an older image must not look current
const STATE_MS = 250;
const OLD_STATE_MS = 1000; // ten periods of a status
const AGE_MS = 100;
const RETRY_MS = 500;
const element = (id) => document.getElementById(id);
const canvas = element("picture");
const drawnAt_ms = []; // times of the images of the last second
let last = 0; // number of the last image, drawn or not: the page requests the next one only after its arrival
let newest = { channel: "", size: "", age_ms: null };

const pause = (time_ms) => new Promise((resolve) => setTimeout(resolve, time_ms));

function showLink(link) {
  element("link").textContent = link;
  element("link").className = link === "connected" ? "" : "lost";
}

async function draw(answer) {
  const bitmap = await createImageBitmap(await answer.blob());
  if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) Object.assign(canvas, { width: bitmap.width, height: bitmap.height });
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
  const age_us = answer.headers.get("X-Age-Us");
  newest = {
    channel: answer.headers.get("X-Channel"), size: `${bitmap.width}x${bitmap.height}`,
    age_ms: age_us === "" ? null : Number(age_us) / 1000,
  };
  bitmap.close();
  drawnAt_ms.push(performance.now());
}

async function showImages() {
  for (;;) {
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

function showState({ robot, online, state, reason, lines }) {
  showLink(online ? "connected" : `no status from ${robot}`);
  element("state").textContent = state;
  element("state").className = state;
  element("reason").textContent = reason;
  element("lines").replaceChildren(...lines.flatMap(([name, text]) => [["dt", name], ["dd", text]]).map(([tag, text]) => {
    const item = document.createElement(tag);
    item.textContent = text;
    return item;
  }));
}

/** Clear the state: an old one must not look current. */
function clearState(link) {
  showState({ state: "", reason: "", lines: [] });
  showLink(link);
}

async function showStates() {
  for (;;) {
    try {
      const { error, ...state } = await (await fetch("state", { signal: AbortSignal.timeout(OLD_STATE_MS) })).json();
      if (error === undefined) showState(state);
      else clearState(error);
    } catch (error) {
      clearState(`\`sightline watch\` ${error.name === "TimeoutError" ? "does not answer" : "has ended"}`);
    }
    await pause(STATE_MS);
  }
}

/** Show the age of the image. It grows while no image arrives, so that a frozen or late image is visible as one. */
function showAge() {
  const now_ms = performance.now();
  while (drawnAt_ms.length > 1 && drawnAt_ms[0] < now_ms - 1000) drawnAt_ms.shift();
  if (drawnAt_ms.length === 0) return;
  const since_ms = now_ms - drawnAt_ms.at(-1);
  const age_ms = since_ms + (newest.age_ms ?? 0);
  element("figure").className = age_ms > OLD_MS ? "old" : "";
  const age = newest.age_ms === null ? "" : `, at least ${Math.round(age_ms)} ms old`;
  element("age").textContent = since_ms > OLD_MS
    ? `no image for ${(since_ms / 1000).toFixed(1)} s`
    : `${newest.channel} ${newest.size}, ${drawnAt_ms.length} images/s${age}`;
}

setInterval(showAge, AGE_MS);
document.onvisibilitychange = document.onresume = showAge; // a hidden page has few timers, or none
showImages();
showStates();
