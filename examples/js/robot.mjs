/**
 * @file A robot of the Sightline protocol: messages in, messages and a twist out. Pure: the caller provides clock, camera, link.
 *
 * @typedef {{name: string, header: object, payload: Uint8Array}} Publication
 */

import { CHANNELS, WireError, encode, readJpegSize, readMessage } from "./codec.mjs";
import { Gate } from "./gate.mjs";
import { isStill } from "./limits.mjs";
import { sessionDigest } from "./proof.mjs";
import { Stream } from "./stream.mjs";
import { publicHolder } from "./validation.mjs";

const PERIODS_US = { status: 100_000, odometry: 50_000, camera: 500_000 };
/** Channels that a robot requests from its peers. */
export const WANTED_CHANNELS = Object.freeze(["twist", "ack", "request", "detections", "mission", "report"]);

export class Robot {
  /**
   * @param {{session: string, fps: number, camera: object, live?: boolean, limits?: object, stopped?: boolean}} options
   *   `camera`: the published CameraModel. `live`: true if two equal images mean a frozen camera
   */
  constructor({ session, fps, camera, live = false, limits = {}, stopped = false }) {
    this.session = session;
    this.camera = camera;
    this.live = live;
    this.gate = new Gate(session, limits, stopped);
    this.stream = new Stream(fps);
    this.pose = { x_m: 0, y_m: 0, yaw_rad: 0 };
    this.seqs = {};
    this.due_us = {};
    this.replies = [];
    this.lastFrame_us = -1;
    this.lastTick_us = null;
    this.rejectedImages = this.tickLateMax_us = this.unwanted = 0;
  }

  // --- receiving -----------------------------------------------------------------------------------------------

  /**
   * Process a message.
   * @param {{channel: object, source: string, header: Uint8Array, payload: Uint8Array}} packet
   * @param {number} now_us
   * @returns {boolean} true if the caller must forward it, unchanged, to every other peer that wants its channel
   */
  onMessage({ channel, source, header, payload }, now_us) {
    if (!WANTED_CHANNELS.includes(channel.name)) {
      this.unwanted += 1;
      return false;
    }
    try {
      const read = readMessage(channel, source, header, payload);
      if (channel.name === "twist") this.onTwist(source, read, now_us);
      else if (channel.name === "ack") this.onAck(source, read.header, now_us);
      else if (channel.name === "request") this.onRequest(source, read, now_us);
      else return read.header.source === source;
    } catch (error) {
      if (channel.name === "twist" || channel.name === "request") this.gate.reject(source, error);
      else if (!(error instanceof WireError)) throw error;
      else if (channel.name === "ack") this.gate.count(error.reason);
    }
    return false;
  }

  onTwist(source, { header, payload }, now_us) {
    const reason = this.gate.offer(source, header, payload, now_us);
    if (header === null || reason === "UNKNOWN_SOURCE" || reason === "NOT_PROVEN") return;
    this.stream.onHolder(this.gate.lease.liveHolder(now_us), now_us);
    this.returnCredit(header, now_us);
  }

  onAck(source, header, now_us) {
    if (header.source === source) this.returnCredit(header, now_us);
  }

  /** Return credit for an answer. An answer cites a frame that this robot issued. */
  returnCredit({ source, session, echo, compute_us }, now_us) {
    if (echo.channel !== "frame" || !this.gate.issued.knows(echo)) return;
    this.stream.onAnswer({ source, session }, echo.seq, compute_us, now_us);
  }

  onRequest(source, { header, payload }, now_us) {
    const reply = { to: sessionDigest(header.source, header.session), id: payload.id, ok: true };
    try {
      if (header.source !== source) throw new WireError("UNKNOWN_SOURCE", "key and header disagree on the source");
      reply.detail = this.gate.request(header, payload.verb, now_us);
    } catch (error) {
      this.gate.reject(source, error);
      reply.ok = false;
      reply.detail = `${error.reason}: ${error.message}`.slice(0, 200);
    }
    this.replies.push({ ...reply, state: this.gate.state });
    if (this.replies.length > 16) this.replies.shift(); // bounds the replies in a flood of requests
  }

  // --- sending -------------------------------------------------------------------------------------------------

  /** Return true if the camera should capture a frame now. */
  mayCapture(now_us) {
    return this.stream.mayCapture(now_us);
  }

  /**
   * Publish the image that was captured at `t_us`.
   * @param {Uint8Array} jpeg
   * @returns {Publication|null} null, counted, for an image that is invalid, too large, or not newer than the last
   */
  onImage(jpeg, t_us, now_us) {
    if (t_us <= this.lastFrame_us || jpeg.length > CHANNELS.frame.maxPayloadBytes || !isJpeg(jpeg)) {
      this.rejectedImages += 1;
      return null;
    }
    this.lastFrame_us = t_us;
    const motion = this.motion();
    const header = { ...this.stamp("frame", t_us), ...motion, applied: motion.moving, latency_us: this.gate.latency_us };
    this.gate.issued.add("frame", header.seq, t_us); // before an answer can arrive
    this.gate.freshness.add(t_us, this.live ? jpeg : null);
    this.stream.onSent(header.seq, t_us, now_us);
    return { name: "frame", header, payload: jpeg };
  }

  /**
   * Step the gate and the wheels, 50 times a second.
   * @param {number} now_us
   * @returns {Publication[]} messages that are due now
   */
  tick(now_us) {
    const twist = this.gate.step(now_us);
    this.move(twist, now_us);
    const due = this.takeReplies(now_us);
    if (this.isDue("status", now_us)) due.push(this.publication("status", this.status(now_us), now_us));
    if (this.isDue("odometry", now_us)) due.push(this.publication("odometry", this.motion(), now_us));
    if (this.isDue("camera", now_us)) due.push(this.publication("camera", this.camera, now_us));
    return due;
  }

  /** Remove the waiting replies. Send them immediately after their requests. */
  takeReplies(now_us) {
    return this.replies.splice(0).map((reply) => this.publication("reply", reply, now_us));
  }

  /** Return true if the wheels are off and at zero. */
  get isAtRest() {
    return !this.gate.armed && isStill(this.gate.applied);
  }

  isDue(name, now_us) {
    if (now_us < (this.due_us[name] ?? 0)) return false;
    this.due_us[name] = Math.max((this.due_us[name] ?? 0) + PERIODS_US[name], now_us + PERIODS_US[name] / 2);
    return true;
  }

  publication(name, payload, t_us) {
    const header = this.stamp(name, t_us);
    if (name === "status") this.gate.issued.add("status", header.seq, t_us);
    return { name, header, payload: encode(payload) };
  }

  stamp(name, t_us) {
    const seq = this.seqs[name] ?? 0;
    this.seqs[name] = seq + 1;
    return { v: 1, session: this.session, seq, t_us };
  }

  status(now_us) {
    const { gate } = this;
    const holder = gate.lease.liveHolder(now_us);
    const stream = { ...this.stream.status(now_us), refused_pictures: this.rejectedImages, calibrated: this.camera.calibrated };
    return {
      state: gate.state,
      reason: gate.reason,
      holder: holder && publicHolder(holder),
      applied: rounded(gate.applied),
      frame_age_us: gate.frameAge_us(now_us),
      latency_us: gate.latency_us,
      accepted: gate.accepted,
      refused: gate.counters,
      last_refusal: gate.lastRejection,
      stream,
      auto_arm: gate.armsItself,
      tick_late_max_us: this.tickLateMax_us,
      max_linear_mps: gate.limits.maxLinear_mps,
      max_angular_rad_s: gate.limits.maxAngular_rad_s,
    };
  }

  /** Move the pose, for wheels without delay or slip. */
  move({ linear_mps, angular_rad_s }, now_us) {
    const elapsed_s = (now_us - (this.lastTick_us ?? now_us)) / 1e6;
    this.lastTick_us = now_us;
    const yaw_rad = this.pose.yaw_rad + (angular_rad_s * elapsed_s) / 2;
    this.pose.x_m += linear_mps * elapsed_s * Math.cos(yaw_rad);
    this.pose.y_m += linear_mps * elapsed_s * Math.sin(yaw_rad);
    this.pose.yaw_rad = wrapped(this.pose.yaw_rad + angular_rad_s * elapsed_s);
  }

  motion() {
    const { x_m, y_m, yaw_rad } = this.pose;
    return { pose: [x_m, y_m, yaw_rad].map((value) => Number(value.toFixed(5))), moving: rounded(this.gate.applied) };
  }
}

const rounded = ({ linear_mps, angular_rad_s }) => [Number(linear_mps.toFixed(4)), Number(angular_rad_s.toFixed(4))];
const wrapped = (angle_rad) => Math.atan2(Math.sin(angle_rad), Math.cos(angle_rad));

function isJpeg(jpeg) {
  try {
    readJpegSize(jpeg);
    return true;
  } catch {
    return false;
  }
}
