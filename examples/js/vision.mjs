/**
 * @file A vision of the Sightline protocol: find a colored blob, steer at it, answer each frame once. Pure; Node and browser.
 *
 * @typedef {{x_px: number, width_px: number, share: number}} Target in pixels of the encoded picture
 */

import { ProofChain, sessionDigest } from "./proof.mjs";

const GAIN_PER_S = 2; // turn rate per radian of bearing; times a total latency of 0.2 s it stays below 0.9
const MAX_ANGULAR_RAD_S = 1.2;
const SEARCH_RAD_S = 0.4;
const CRUISE_MPS = 0.25;
const STOP_SHARE = 0.18; // of the picture's width: near enough
const MIN_PX = 128; // pixels of the encoded picture, two 8x8 blocks: fewer are noise

/** Yellow: red and green strong and alike, blue far below. */
export const isYellow = (red, green, blue) => red > 110 && green > 85 && blue < 0.6 * green && Math.abs(red - green) < 0.4 * red;

/**
 * A plain scan over the pixels: middle and extent of all that is of the color.
 * @param {{width: number, height: number, scale: number, data: ArrayLike<number>, channels: 3|4}} picture
 *   `scale` is how many pixels of the encoded picture one of these is wide
 * @returns {Target|null}
 */
export function findTarget({ width, height, scale, data, channels }, isColor = isYellow) {
  const columns = new Uint32Array(width);
  let count = 0;
  for (let y = 0, at = 0; y < height; y += 1) {
    for (let x = 0; x < width; x += 1, at += channels) {
      if (!isColor(data[at], data[at + 1], data[at + 2])) continue;
      columns[x] += 1;
      count += 1;
    }
  }
  if (count * scale * scale < MIN_PX) return null;
  const sum = columns.reduce((total, found, x) => total + found * (x + 0.5), 0);
  const filled = columns.reduce((total, found) => total + (found > 0 ? 1 : 0), 0);
  return { x_px: (sum / count) * scale, width_px: filled * scale, share: filled / width };
}

/**
 * Turn towards the target, go on until it is large. Nothing in sight: look round, towards where it was last.
 * @param {Target|null} target
 * @param {{width_px: number, fx_px: number, cx_px: number}} camera
 * @param {number} side 1 left, -1 right
 * @returns {import("./limits.mjs").Twist}
 */
export function steer(target, camera, side = 1) {
  if (target === null) return { linear_mps: 0, angular_rad_s: side * SEARCH_RAD_S };
  const bearing_rad = Math.atan2(camera.cx_px - target.x_px, camera.fx_px); // left is positive
  const turn_rad_s = GAIN_PER_S * bearing_rad;
  const speedFactor = Math.max(0, 1 - target.share / STOP_SHARE);
  return {
    linear_mps: CRUISE_MPS * speedFactor * Math.max(0, Math.cos(2 * bearing_rad)),
    angular_rad_s: Math.max(-MAX_ANGULAR_RAD_S, Math.min(MAX_ANGULAR_RAD_S, turn_rad_s)),
  };
}

const AHEAD_US = 500_000; // more than links and clocks differ
export const OPERATOR = "operator"; // the one role whose token permits requests

/** What a vision knows of one robot, and the headers of its answers. */
export class Vision {
  /** @param {string} session 8 hex digits @param {string} source the role: `vision`, or `operator` to watch only */
  constructor(session, source = "vision") {
    this.session = session;
    this.source = source;
    this.proofs = new ProofChain();
    this.robotSession = "";
    this.camera = null;
    this.lastSeq = this.last_us = -1;
    this.received_us = -Infinity; // when the last new frame came, by this machine's clock
    this.side = 1; // where the target was last: left
    this.seq = this.requestSeq = this.requestId = 0;
    this.status = null; // {header, payload}: the newest
  }

  /** What others see of source and session. */
  get digest() {
    return sessionDigest(this.source, this.session);
  }

  /** Whom replies to its requests name. */
  get requester() {
    return sessionDigest(OPERATOR, this.session);
  }

  /** A new session of the robot: what was learned from the old one is forgotten. */
  onSession(session) {
    if (session === this.robotSession) return;
    this.robotSession = session;
    this.camera = this.status = null;
    this.lastSeq = this.last_us = -1;
    this.side = 1;
  }

  /** @param {{session: string}} header @param {object} model */
  onCamera(header, model) {
    this.onSession(header.session);
    this.camera = model;
  }

  onStatus(header, payload) {
    this.onSession(header.session);
    this.status = { header, payload };
  }

  /**
   * Whether a frame is newer than all before, and does not run ahead of this machine's clock: that one is forged.
   * @param {{session: string, seq: number, t_us: number}} header
   */
  isNew({ session, seq, t_us = 0 }, now_us = 0) {
    this.onSession(session);
    const silent_us = now_us - this.received_us;
    if (silent_us > AHEAD_US) this.lastSeq = this.last_us = -1; // what came last was not of the robot, or it paused
    const ahead = this.last_us >= 0 && t_us - this.last_us > silent_us + AHEAD_US;
    if (ahead || seq <= this.lastSeq) return false;
    this.lastSeq = seq;
    this.received_us = now_us;
    return true;
  }

  /** Whether the robot's clock went on since the last frame; one that did not is no frame to steer by. */
  advances({ t_us }) {
    const later = t_us > this.last_us;
    this.last_us = Math.max(this.last_us, t_us);
    return later;
  }

  /** The twist for what was found; null without the camera's model. @param {Target|null} target */
  twistFor(target) {
    if (this.camera === null) return null;
    if (target !== null) this.side = target.x_px <= this.camera.cx_px ? 1 : -1;
    return steer(target, this.camera, this.side);
  }

  /**
   * Header of the one answer to a frame.
   * @param {{session: string, seq: number, t_us: number}} frame its header, cited field for field
   * @param {number} compute_us from receiving the frame to sending the answer
   */
  answerHeader({ session, seq, t_us }, compute_us, proof = {}) {
    this.seq += 1;
    const echo = { channel: "frame", session, seq, t_us };
    return { v: 1, source: this.source, session: this.session, seq: this.seq, echo, compute_us: Math.max(0, Math.round(compute_us)), ...proof };
  }

  /**
   * A request, as an operator; what lets the robot move again cites the newest status.
   * @param {string} verb
   * @returns {{header: object, payload: {id: number, verb: string}}}
   */
  request(verb) {
    this.requestSeq += 1;
    this.requestId += 1;
    const stamp = this.status?.header;
    const echo = stamp ? { channel: "status", session: stamp.session, seq: stamp.seq, t_us: stamp.t_us } : null;
    const header = { v: 1, source: OPERATOR, session: this.session, seq: this.requestSeq, echo };
    return { header, payload: { id: this.requestId, verb } };
  }
}
