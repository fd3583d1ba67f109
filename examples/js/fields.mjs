/**
 * @file Field tables of the headers and JSON payloads of the protocol. Pure.
 *
 * One entry per row of the tables in `protocol/README.md`. A type is a function `(value, path) -> value` that throws
 * {@link FieldError}; a field is `[type]`, or `[type, default]` if it may be absent.
 */

import { Real } from "./json.mjs";

/** Largest integer on the wire. Every JSON reader represents it exactly. */
export const MAX_INTEGER = Number.MAX_SAFE_INTEGER;
export const VERSION = 1;

/** An invalid value. `path` names the field. */
export class FieldError extends Error {
  constructor(path, problem) {
    super(`${path}: ${problem}`);
    this.path = path;
  }
}

const fail = (path, expected) => {
  throw new FieldError(path, `expected ${expected}`);
};

const integer = (min, max) => (value, path) =>
  typeof value === "number" && value >= min && value <= max ? value : fail(path, `an integer ${min} to ${max}`);

const number = (min, max, open = false) => (value, path) => {
  const plain = value instanceof Real ? value.value : value;
  const inside = typeof plain === "number" && plain <= max && (open ? plain > min : plain >= min);
  return inside ? plain : fail(path, `a number ${open ? "above" : "from"} ${min} to ${max}`);
};

/** Text of at most `max` code points, not UTF-16 units. */
const text = (max) => (value, path) =>
  typeof value === "string" && [...value].length <= max ? value : fail(path, `text of at most ${max} characters`);

const matching = (pattern) => (value, path) =>
  typeof value === "string" && pattern.test(value) ? value : fail(path, `text that matches ${pattern}`);

const oneOf = (...names) => (value, path) => (names.includes(value) ? value : fail(path, `one of ${names}`));

const boolean = (value, path) => (typeof value === "boolean" ? value : fail(path, "true or false"));

const list = (type, min, max) => (value, path) =>
  Array.isArray(value) && value.length >= min && value.length <= max
    ? value.map((item, index) => type(item, `${path}.${index}`))
    : fail(path, `a list of ${min} to ${max}`);

const map = (type, max = Infinity, named = /^/) => (value, path) => {
  if (!isObject(value) || Object.keys(value).length > max) fail(path, `an object of at most ${max} fields`);
  for (const name of Object.keys(value)) if (!named.test(name)) fail(path, `names that match ${named}`);
  return Object.fromEntries(Object.entries(value).map(([name, item]) => [name, type(item, `${path}.${name}`)]));
};

const orNull = (type) => (value, path) => (value === null ? null : type(value, path));

const object = (fields) => (value, path) => readFields(fields, value, path);

/** @param {unknown} value */
function isObject(value) {
  return typeof value === "object" && value !== null && !Array.isArray(value) && !(value instanceof Real);
}

/**
 * Check every field of the table, fill in defaults and omit unknown fields.
 * @param {Record<string, Array>} fields
 * @param {unknown} value as {@link import("./json.mjs").parseJson} returns it
 * @throws {FieldError}
 */
export function readFields(fields, value, path = "") {
  if (!isObject(value)) fail(path, "an object");
  const read = {};
  for (const [name, [type, fallback]] of Object.entries(fields)) {
    const fieldPath = path ? `${path}.${name}` : name;
    if (value[name] !== undefined) read[name] = type(value[name], fieldPath);
    else if (fallback === undefined) throw new FieldError(fieldPath, "missing");
    else read[name] = structuredClone(fallback);
  }
  return read;
}

const counter = integer(0, MAX_INTEGER);
const real = number(-1e6, 1e6);
const session = matching(/^[0-9a-f]{8}$/);
const element = matching(/^[0-9a-f]{32}$/);
const source = matching(/^[a-z][a-z0-9_]{0,15}$/);
const pose = list(real, 3, 3);
const planar = list(real, 2, 2);
const version = integer(VERSION, VERSION);
const any = (value, path) => (typeof value === "string" ? value : fail(path, "text"));

export const Echo = {
  channel: [oneOf("frame", "status", "beat")], session: [session], seq: [counter], t_us: [counter],
};
export const Stamp = { v: [version, VERSION], session: [session], seq: [counter], t_us: [counter] };
export const FrameHeader = {
  ...Stamp,
  pose: [pose, [0, 0, 0]],
  moving: [planar, [0, 0]],
  applied: [planar, [0, 0]],
  latency_us: [orNull(counter), null],
};
export const ScanHeader = {
  ...Stamp, angle_min_rad: [real], angle_increment_rad: [real], range_min_m: [real], range_max_m: [real],
};
const SenderHeader = { v: [version, VERSION], source: [source], session: [session], seq: [counter] };
export const RequestId = { digest: [session], id: [counter] };
export const AnswerHeader = {
  ...SenderHeader, echo: [object(Echo)], compute_us: [counter, 0], scan: [orNull(counter), null],
  mission: [orNull(object(RequestId)), null], proof: [orNull(element), null], next_proof: [orNull(element), null],
};
export const RequestHeader = {
  ...SenderHeader, echo: [orNull(object(Echo)), null], proof: [orNull(element), null], next_proof: [orNull(element), null],
};

export const VERBS = ["arm", "disarm", "stop", "reset", "acquire", "release"];
export const STATES = ["DISARMED", "HOLD", "ACTIVE", "DEGRADED", "STOPPED", "FAULT"];
export const Request = { id: [counter], verb: [oneOf(...VERBS)] };
export const Reply = { to: [session], id: [counter], ok: [boolean], state: [any], detail: [text(200)] };
export const Odometry = { pose: [pose], moving: [planar] };

export const LeaseHolder = { source: [source], digest: [session] };
export const LastRejection = { source: [text(32)], reason: [text(32)], detail: [text(200)] };
export const StreamStatus = {
  sent: [counter, 0],
  credit_timeouts: [counter, 0],
  window: [counter, 1],
  fps: [real, 0],
  dropped_commands: [counter, 0],
  refused_pictures: [counter, 0],
  calibrated: [boolean, false],
  overtaken: [counter, 0],
  dropped: [map(counter, 16), {}],
  missed_captures: [counter, 0],
  quality_percent: [integer(0, 100), 100],
  scale_percent: [integer(0, 100), 100],
  camera_fault: [text(200), ""],
};
export const Status = {
  state: [oneOf(...STATES)],
  reason: [text(200)],
  holder: [orNull(object(LeaseHolder)), null],
  applied: [planar, [0, 0]],
  frame_age_us: [orNull(counter), null],
  latency_us: [orNull(counter), null],
  accepted: [counter, 0],
  refused: [map(counter), {}],
  last_refusal: [orNull(object(LastRejection)), null],
  stream: [object(StreamStatus), readFields(StreamStatus, {})],
  auto_arm: [boolean, false],
  tick_late_max_us: [counter, 0],
  network_restarts: [counter, 0],
  faults: [map(counter), {}],
  battery_v: [orNull(real), null],
  max_linear_mps: [real, 0],
  max_angular_rad_s: [real, 0],
};
export const CameraModel = {
  width_px: [integer(16, 8192)],
  height_px: [integer(16, 8192)],
  fx_px: [number(0, 1e5, true)],
  fy_px: [number(0, 1e5, true)],
  cx_px: [real],
  cy_px: [real],
  distortion: [list(real, 0, 8), []],
  x_m: [real, 0],
  y_m: [real, 0],
  z_m: [real, 0],
  pitch_rad: [real, 0],
  calibrated: [boolean, false],
};
export const DetectedCircle = { cx_px: [real], cy_px: [real], radius_px: [number(0, 1e6, true)] };
const corners = {
  label: [matching(/^[^\x00-\x1f\x7f]{1,64}$/u)],
  score: [number(0, 1)],
  x1_px: [real],
  y1_px: [real],
  x2_px: [real],
  y2_px: [real],
  circle: [orNull(object(DetectedCircle)), null],
  track: [orNull(counter), null],
};
const DetectedBox = (value, path) => {
  const box = readFields(corners, value, path);
  return box.x2_px >= box.x1_px && box.y2_px >= box.y1_px ? box : fail(path, "x2_px >= x1_px and y2_px >= y1_px");
};
export const DetectionsHeader = { ...SenderHeader, echo: [orNull(object(Echo)), null], compute_us: [counter, 0] };
export const Detections = {
  width_px: [integer(16, 8192)], height_px: [integer(16, 8192)], boxes: [list(DetectedBox, 0, 64), []],
  detector: [text(64), ""], device: [text(32), ""], model: [text(64), ""],
};
const meters = number(-100, 100);
const option = (value, path) => (typeof value === "boolean" ? value : typeof value === "string" ? text(64)(value, path) : real(value, path));
export const MissionRequest = {
  id: [counter],
  name: [matching(/^[a-z][a-z0-9-]{0,31}$/)],
  waypoints: [list(list(meters, 2, 2), 0, 64), []],
  options: [map(option, 16, /^[a-z][a-z0-9_.]{0,63}$/), {}],
};
export const ReportedTarget = {
  label: [matching(/^[^\x00-\x1f\x7f]{1,64}$/u)], score: [number(0, 1)], track: [orNull(counter), null],
  bearing_rad: [orNull(real), null], distance_m: [orNull(number(0, 1e6)), null], cx_px: [real], cy_px: [real],
  radius_px: [orNull(number(0, 1e6, true)), null], width_px: [integer(16, 8192)], height_px: [integer(16, 8192)],
};
export const MissionReport = {
  mission: [text(64)],
  phase: [text(32)],
  note: [text(200), ""],
  done: [boolean, false],
  asked: [orNull(object(RequestId)), null],
  refused: [text(200), ""],
  detector: [text(64), ""],
  device: [text(32), ""],
  model: [text(64), ""],
  inference_us: [orNull(counter), null],
  faults: [map(counter), {}],
  target: [orNull(object(ReportedTarget)), null],
};
export const Hello = {
  v: [version, VERSION],
  robot: [matching(/^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$/)],
  role: [matching(/^([a-z][a-z0-9_]{0,15})?$/), ""],
  session: [session],
  wants: [list(text(32), 0, 32), []],
};
