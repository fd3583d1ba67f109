/**
 * @file Find a colored blob, steer at it, and write the answer to each frame. Pure; Node and browser.
 *
 * @typedef {{x_px: number, width_px: number, share: number}} Target in px of the encoded image; share: of its width
 */

import { ProofChain, sessionDigest } from "./proof.mjs";

const GAIN_PER_S = 2; // turn rate per bearing; stable because gain times a latency of 0.2 s is below 0.9
const MAX_ANGULAR_RAD_S = 1.2;
const SEARCH_RAD_S = 0.4;
const CRUISE_MPS = 0.25;
const STOP_SHARE = 0.18; // of the image width; a target of this size is near enough
const MIN_PX = 128; // of the encoded image, two 8x8 blocks; a smaller blob is noise

/** Return true for yellow: high and similar red and green, low blue. */
export const isYellow = (red, green, blue) => red > 110 && green > 85 && blue < 0.6 * green && Math.abs(red - green) < 0.4 * red;

/**
 * Compute center and extent of all pixels of a color.
 * @param {{width: number, height: number, scale: number, data: ArrayLike<number>, channels: 3|4}} pixels
 *   `scale`: pixels of the encoded image per pixel of `data`, in each direction
 * @returns {Target|null} null without a target
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
 * Compute the twist: turn toward the target and approach it until it is large. Without a target, turn to search for it.
 * @param {Target|null} target
 * @param {{width_px: number, fx_px: number, cx_px: number}} camera
 * @param {number} side where the target was last: 1 left, -1 right
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

const AHEAD_US = 500_000; // more than the links and clocks of one robot differ
export const OPERATOR = "operator"; // the only role whose token permits requests

/** State of a vision service or viewer for one robot. Writes the headers of its messages. */
export class Vision {
  /** @param {string} session 8 hex digits @param {string} source role: `vision`, or `operator` to watch only */
  constructor(session, source = "vision") {
    this.session = session;
    this.source = source;
    this.proofs = new ProofChain();
    this.robotSession = "";
    this.camera = null;
    this.lastSeq = this.last_us = -1;
    this.received_us = -Infinity; // arrival of the last new frame, on the clock of this machine
    this.side = 1; // where the target was last: 1 left, -1 right
    this.seq = this.requestSeq = this.requestId = 0;
    this.status = null; // {header, payload}: the newest
  }

  /** The digest by which a status names this peer as the driver. */
  get digest() {
    return sessionDigest(this.source, this.session);
  }

  /** The digest in replies to requests of this peer. */
  get requester() {
    return sessionDigest(OPERATOR, this.session);
  }

  /** Discard the state of an earlier session of the robot. */
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
   * Return true if a frame is newer than all others and its time is possible. A time that runs ahead is forged.
   * @param {{session: string, seq: number, t_us: number}} header
   */
  isNew({ session, seq, t_us = 0 }, now_us = 0) {
    this.onSession(session);
    const silent_us = now_us - this.received_us;
    if (silent_us > AHEAD_US) this.lastSeq = this.last_us = -1; // the last frame was forged, or the robot paused
    const ahead = this.last_us >= 0 && t_us - this.last_us > silent_us + AHEAD_US;
    if (ahead || seq <= this.lastSeq) return false;
    this.lastSeq = seq;
    this.received_us = now_us;
    return true;
  }

  /** Return true if the clock of the robot advanced since the last frame. Otherwise no twist may cite the frame. */
  advances({ t_us }) {
    const later = t_us > this.last_us;
    this.last_us = Math.max(this.last_us, t_us);
    return later;
  }

  /** Compute the twist, or null without a camera model. @param {Target|null} target */
  twistFor(target) {
    if (this.camera === null) return null;
    if (target !== null) this.side = target.x_px <= this.camera.cx_px ? 1 : -1;
    return steer(target, this.camera, this.side);
  }

  /**
   * Write the header of the answer to a frame.
   * @param {{session: string, seq: number, t_us: number}} frame its header, whose fields the answer cites
   * @param {number} compute_us from receiving the frame to sending the answer
   */
  answerHeader({ session, seq, t_us }, compute_us, proof = {}) {
    this.seq += 1;
    const echo = { channel: "frame", session, seq, t_us };
    return { v: 1, source: this.source, session: this.session, seq: this.seq, echo, compute_us: Math.max(0, Math.round(compute_us)), ...proof };
  }

  /**
   * Write a request of an operator. It cites the newest status, as a request that permits motion must.
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
