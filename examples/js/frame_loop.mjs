/**
 * @file What a vision or a viewer does with what a robot sends: the newest frame is looked at and answered once. Pure.
 *
 * The caller brings the picture decoder, the clock and the link, so that Node and the browser run the same code.
 */

import { WireError, checkSizes, decode, encode, formatTwist, readJpegSize, readMessage } from "./codec.mjs";
import { findTarget } from "./vision.mjs";

const EMPTY = new Uint8Array(0);
/** Channels that these eyes want of a robot. */
export const WANTED_CHANNELS = Object.freeze(["frame", "camera", "status", "reply"]);
const DRIFT = 5000; // two quartz clocks differ by less than 1 in this

/** How late a robot's messages come, without synchronized clocks: at least by what they lose on the fastest of the session. */
export class RobotClock {
  constructor() {
    this.session = "";
  }

  /**
   * Learn from a message at its arrival.
   * @param {{session: string, t_us: number}} stamp @param {number} now_us
   * @returns {number} its least possible age, in us
   */
  age_us({ session, t_us }, now_us) {
    const drift_us = (now_us - this.received_us) / DRIFT;
    const learned_us = session === this.session ? this.offset_us + drift_us : Infinity;
    Object.assign(this, { session, received_us: now_us, offset_us: Math.min(learned_us, now_us - t_us) });
    return now_us - t_us - this.offset_us;
  }
}

export class FrameLoop {
  /**
   * @param {import("./vision.mjs").Vision} vision
   * @param {object} environment
   * @param {(jpeg: Uint8Array) => object|Promise<object>} environment.decodeImage decodes (and draws) a picture, for `findTarget`
   * @param {(name: string, header: object, payload: Uint8Array) => void} environment.send
   * @param {() => number} environment.now_us
   * @param {() => Promise<void>} [environment.pause] lets what has arrived be read first, so that the newest frame wins
   * @param {(what: object) => void} [environment.onDecision] told of each answer: {target, twist, age_us}, the least age of its frame
   * @param {(reply: object) => void} [environment.onReply]
   */
  constructor(vision, { decodeImage, send, now_us, pause = async () => undefined, onDecision = () => undefined, onReply = () => undefined }) {
    Object.assign(this, { vision, decodeImage, send, now_us, pause, onDecision, onReply });
    this.drives = true; // otherwise frames are acknowledged only
    this.clock = new RobotClock();
    this.newest = null;
    this.busy = false;
    this.skipped = {}; // reason -> count
    this.answered = 0;
  }

  /**
   * @param {{channel: object, source: string, header: Uint8Array, payload: Uint8Array}} packet
   * @returns {Promise<void>|undefined} when all that had arrived is answered
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

  /** One place for a frame, the newest; whoever was in it is not answered. */
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

  /** The twist for a frame; null where it is only acknowledged: a bad picture, or nobody drives from here. */
  async decide({ stamp, jpeg, arrival_us, age_us }) {
    try {
      if (!this.vision.advances(stamp)) throw new WireError("OUT_OF_ORDER", "the robot's clock stands still");
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

  /** @throws {WireError} for what no decoder should see, or is not what the camera's model says */
  checkImage(jpeg) {
    const { width_px, height_px } = readJpegSize(jpeg);
    const { camera } = this.vision;
    if (camera !== null && (camera.width_px !== width_px || camera.height_px !== height_px)) {
      throw new WireError("MALFORMED", `picture of ${width_px}x${height_px}, the camera makes ${camera.width_px}x${camera.height_px}`);
    }
  }

  answer({ stamp, arrival_us }, twist) {
    this.answered += 1;
    const proof = twist === null ? {} : this.vision.proofs.next();
    const header = this.vision.answerHeader(stamp, this.now_us() - arrival_us, proof);
    if (twist === null) this.send("ack", header, EMPTY);
    else this.send("twist", header, formatTwist(twist));
  }

  /** @param {string} verb @returns {number} the id that the reply will bear */
  request(verb) {
    const { header, payload } = this.vision.request(verb);
    this.send("request", header, encode(payload));
    return payload.id;
  }

  /** A picture that a browser's decoder refuses is no {@link WireError}, and no reason to end either. */
  skip(error) {
    const reason = error instanceof WireError ? error.reason : "UNDECODABLE";
    this.skipped[reason] = (this.skipped[reason] ?? 0) + 1;
  }
}
