/**
 * @file Process the messages of a robot for a vision service or viewer: answer the newest frame once. Pure.
 *
 * The caller provides the image decoder, the clock and the link, so that Node and the browser run the same code.
 */

import { WireError, checkSizes, decode, encode, formatTwist, readJpegSize, readMessage } from "./codec.mjs";
import { findTarget } from "./vision.mjs";

const EMPTY = new Uint8Array(0);
/** Channels that a vision service or viewer requests from a robot. */
export const WANTED_CHANNELS = Object.freeze(["frame", "camera", "status", "reply"]);
const DRIFT = 5000; // two quartz clocks differ by less than 1 in 5000

/** Estimates the age of messages without synchronized clocks: their delay beyond that of the fastest message of the session. */
export class RobotClock {
  constructor() {
    this.session = "";
  }

  /**
   * Learn from a message at its arrival.
   * @param {{session: string, t_us: number}} stamp @param {number} now_us
   * @returns {number} its lowest possible age, us
   */
  age_us({ session, t_us }, now_us) {
    const drift_us = (now_us - this.received_us) / DRIFT;
    const learned_us = session === this.session ? this.offset_us + drift_us : Infinity;
    Object.assign(this, { session, received_us: now_us, offset_us: Math.min(learned_us, now_us - t_us) });
    return now_us - t_us - this.offset_us;
  }
}

/** Decodes the newest frame, finds the target and answers. */
export class FrameLoop {
  /**
   * @param {import("./vision.mjs").Vision} vision
   * @param {object} environment
   * @param {(jpeg: Uint8Array) => object|Promise<object>} environment.decodeImage decodes (and draws) an image for `findTarget`
   * @param {(name: string, header: object, payload: Uint8Array) => void} environment.send
   * @param {() => number} environment.now_us
   * @param {() => Promise<void>} [environment.pause] ends when all received messages are read, so that the newest frame wins
   * @param {(decision: object) => void} [environment.onDecision] receives {target, twist, age_us}; age_us: lowest age of the frame
   * @param {(reply: object) => void} [environment.onReply]
   */
  constructor(vision, { decodeImage, send, now_us, pause = async () => undefined, onDecision = () => undefined, onReply = () => undefined }) {
    Object.assign(this, { vision, decodeImage, send, now_us, pause, onDecision, onReply });
    this.drives = true; // false: acknowledge frames without a twist
    this.clock = new RobotClock();
    this.newest = null;
    this.busy = false;
    this.skipped = {}; // reason -> count
    this.answered = 0;
  }

  /**
   * Process one message.
   * @param {{channel: object, source: string, header: Uint8Array, payload: Uint8Array}} packet
   * @returns {Promise<void>|undefined} resolves when no frame waits for an answer
   */
  onMessage(packet) {
    try {
      if (packet.channel.name === "frame") return this.onFrame(packet);
      if (WANTED_CHANNELS.includes(packet.channel.name)) this.onState(packet);
    } catch (error) {
      this.skip(error);
    }
    return undefined;
  }

  onState({ channel, source, header, payload }) {
    const read = readMessage(channel, source, header, payload);
    if (channel.name === "camera") this.vision.onCamera(read.header, read.payload);
    if (channel.name === "status") {
      this.clock.age_us(read.header, this.now_us());
      this.vision.onStatus(read.header, read.payload);
    }
    if (channel.name === "reply" && read.payload.to === this.vision.requester) this.onReply(read.payload);
  }

  /** Store the newest frame. The frame that it replaces gets no answer. @throws {WireError} */
  onFrame({ channel, header, payload }) {
    checkSizes(channel, header, payload);
    const stamp = decode(channel.header, header);
    const arrival_us = this.now_us();
    if (!this.vision.isNew(stamp, arrival_us)) throw new WireError("OUT_OF_ORDER", `frame ${stamp.seq} is not newer than the last`);
    this.newest = { stamp, jpeg: payload, arrival_us, age_us: this.clock.age_us(stamp, arrival_us) };
    return this.busy ? undefined : this.work();
  }

  async work() {
    this.busy = true;
    await this.pause();
    while (this.newest !== null) {
      const frame = this.newest;
      this.newest = null;
      this.answer(frame, await this.decide(frame));
    }
    this.busy = false;
  }

  /** Compute the twist for a frame, or null to acknowledge it only: an invalid image, or this peer does not drive. */
  async decide({ stamp, jpeg, arrival_us, age_us }) {
    try {
      if (!this.vision.advances(stamp)) throw new WireError("OUT_OF_ORDER", "the clock of the robot does not advance");
      this.checkImage(jpeg);
      const target = findTarget(await this.decodeImage(jpeg));
      const twist = this.drives ? this.vision.twistFor(target) : null;
      this.onDecision({ target, twist, age_us: age_us + this.now_us() - arrival_us });
      return twist;
    } catch (error) {
      this.skip(error);
      return null;
    }
  }

  /** @throws {WireError} MALFORMED for an unsupported image, or a size other than that of the camera model */
  checkImage(jpeg) {
    const { width_px, height_px } = readJpegSize(jpeg);
    const { camera } = this.vision;
    if (camera !== null && (camera.width_px !== width_px || camera.height_px !== height_px)) {
      throw new WireError("MALFORMED", `image is ${width_px}x${height_px}, the camera model ${camera.width_px}x${camera.height_px}`);
    }
  }

  answer({ stamp, arrival_us }, twist) {
    this.answered += 1;
    const proof = twist === null ? {} : this.vision.proofs.next();
    const header = this.vision.answerHeader(stamp, this.now_us() - arrival_us, proof);
    if (twist === null) this.send("ack", header, EMPTY);
    else this.send("twist", header, formatTwist(twist));
  }

  /** Send a request. @param {string} verb @returns {number} the id of its reply */
  request(verb) {
    const { header, payload } = this.vision.request(verb);
    this.send("request", header, encode(payload));
    return payload.id;
  }

  /** Count a skipped frame or message. The image decoder of a browser throws errors other than {@link WireError}. */
  skip(error) {
    const reason = error instanceof WireError ? error.reason : "UNDECODABLE";
    this.skipped[reason] = (this.skipped[reason] ?? 0) + 1;
  }
}
