/**
 * @file Decide when to send a frame: credit, timeouts, window, rate. Pure.
 *
 * A frame is captured only with credit, so that it is young when it leaves and no queue grows.
 */

import { isSame } from "./validation.mjs";

const FIRST_TIMEOUT_US = 120_000;
const MAX_TIMEOUT_US = 500_000;
const OWNER_LIFE_US = 1_000_000;
const MAX_WINDOW = 12;
const REMEMBERED = 64;
const DELAYS_KEPT = 12;

export class Stream {
  /** @param {number} fps of the camera */
  constructor(fps) {
    this.interval_us = Math.round(1e6 / fps);
    this.expires_us = new Map(); // seq in flight -> time at which its credit returns
    this.sentAt_us = new Map(); // includes frames whose credit has timed out
    this.owner = null;
    this.ownerUntil_us = 0;
    this.delays_us = [];
    this.answer_us = null;
    this.next_us = 0;
    this.sent = this.creditTimeouts = 0;
    this.lastSecond_us = [];
  }

  /** Return true if the frame interval is over and the stream has credit. */
  mayCapture(now_us) {
    for (const [seq, expires_us] of this.expires_us) {
      if (now_us >= expires_us) {
        this.expires_us.delete(seq);
        this.creditTimeouts += 1;
      }
    }
    return now_us >= this.next_us && this.expires_us.size < this.window;
  }

  onSent(seq, t_us, now_us) {
    this.expires_us.set(seq, now_us + this.timeout_us);
    this.sentAt_us.set(seq, now_us);
    if (this.sentAt_us.size > REMEMBERED) this.sentAt_us.delete(this.sentAt_us.keys().next().value);
    this.next_us = Math.max(this.next_us + this.interval_us, t_us + this.interval_us / 2); // a late tick does not reduce the rate
    this.sent += 1;
    this.lastSecond_us.push(now_us);
    while (this.lastSecond_us[0] < now_us - 1_000_000) this.lastSecond_us.shift();
  }

  /**
   * Note an answer (twist or ack) to frame `seq`. It returns the credit of this frame and of all older ones.
   * @param {import("./validation.mjs").Holder} sender
   */
  onAnswer(sender, seq, compute_us, now_us) {
    if ((this.owner === null || now_us >= this.ownerUntil_us) && !isSame(sender, this.owner)) this.handOver(sender);
    if (!isSame(sender, this.owner)) return;
    this.ownerUntil_us = now_us + OWNER_LIFE_US;
    const sent_us = this.sentAt_us.get(seq);
    if (sent_us !== undefined) this.measure(now_us - sent_us, compute_us);
    this.sentAt_us.delete(seq);
    for (const older of this.expires_us.keys()) if (older <= seq) this.expires_us.delete(older);
  }

  /** Pass the credit to a new holder of the lease. */
  onHolder(holder, now_us) {
    if (holder === null || isSame(holder, this.owner)) return;
    this.handOver(holder);
    this.ownerUntil_us = now_us + OWNER_LIFE_US;
    this.expires_us.clear();
  }

  /** Pass the credit to another peer. The times of the previous owner do not apply to its link. */
  handOver(sender) {
    this.owner = sender;
    this.delays_us = [];
    this.answer_us = null;
  }

  measure(answer_us, compute_us) {
    this.delays_us.push(Math.max(0, answer_us - compute_us));
    if (this.delays_us.length > DELAYS_KEPT) this.delays_us.shift();
    this.answer_us = this.answer_us === null ? answer_us : 0.9 * this.answer_us + 0.1 * answer_us;
  }

  /** Frames that may be in flight: as many as the camera captures in one round trip of the link, without computing time. */
  get window() {
    if (this.delays_us.length === 0) return 1;
    return Math.min(MAX_WINDOW, 1 + Math.floor(Math.min(...this.delays_us) / this.interval_us));
  }

  get timeout_us() {
    if (this.answer_us === null) return FIRST_TIMEOUT_US;
    return Math.min(MAX_TIMEOUT_US, Math.round(1.5 * this.answer_us) + 12_000);
  }

  /** Return the `stream` field of a status. @returns {object} */
  status(now_us) {
    const fps = this.lastSecond_us.filter((sent_us) => now_us - sent_us <= 1_000_000).length;
    return { sent: this.sent, credit_timeouts: this.creditTimeouts, window: this.window, fps };
  }
}
