/**
 * @file Records for the validation of commands: issued messages, sequence numbers, the lease. Pure.
 *
 * No rule trusts the sender. A frame is known because this robot issued it. Its age comes from the robot's own clock.
 *
 * @typedef {{source: string, session: string}} Holder
 */

import { WireError } from "./codec.mjs";
import { STILL, isStill } from "./limits.mjs";
import { continues, sessionDigest } from "./proof.mjs";

const KEPT_PER_CHANNEL = 256; // 8 s of frames at 30 fps; an older frame is STALE
const KEPT_SENDERS = 64;
const SENDER_MEMORY_US = 10_000_000;
const MAX_FIRST_SEQ = 2 ** 32;
const MAX_SEQ_JUMP = 2 ** 20;

/** Roles that may drive, by rank. */
export const RANKS = Object.freeze(Object.assign(Object.create(null), { guest: 0, vision: 1, teleop: 2 }));
const NO_PROOF = Object.freeze({ proof: null, next_proof: null });
export const proofOf = (header) => (header === null ? NO_PROOF : { proof: header.proof ?? null, next_proof: header.next_proof ?? null });
/** Return the public name of a driver, without its session, which a peer could copy. */
export const publicHolder = ({ source, session }) => ({ source, digest: sessionDigest(source, session) });
export const isHuman = (source) => source === "teleop";
export const isSame = (one, other) => one !== null && other !== null && one.source === other.source && one.session === other.session;

/** Stores the time of each message of this robot session by channel and sequence number. */
export class IssuedRecord {
  /** @param {string} session */
  constructor(session) {
    this.session = session;
    this.times = { frame: new Map(), status: new Map(), beat: new Map() };
    this.deniedSeq = -1;
    this.lastStatusSeq = -1;
  }

  /** Store a message. Call this before publishing it, so that no answer can arrive earlier. */
  add(channel, seq, t_us) {
    const times = this.times[channel];
    times.set(seq, t_us);
    if (times.size > KEPT_PER_CHANNEL) times.delete(times.keys().next().value);
    if (channel === "status") this.lastStatusSeq = seq;
  }

  knows(echo) {
    return echo.session === this.session && this.times[echo.channel].get(echo.seq) === echo.t_us;
  }

  /** Compute the age of the cited message. @returns {number} us @throws {WireError} OTHER_SESSION, UNKNOWN_FRAME, FROM_FUTURE, STALE */
  age_us(echo, now_us, maxAge_us) {
    if (echo.session !== this.session) throw new WireError("OTHER_SESSION", `cites robot session ${echo.session}, this is ${this.session}`);
    if (!this.knows(echo)) throw new WireError("UNKNOWN_FRAME", `cites ${echo.channel} ${echo.seq}, unknown to this robot`);
    const age_us = now_us - echo.t_us;
    if (age_us < 0) throw new WireError("FROM_FUTURE", `cites ${echo.channel} ${echo.seq} from ${-age_us} us ahead`);
    if (age_us > maxAge_us) throw new WireError("STALE", `${echo.channel} ${echo.seq} is ${Math.round(age_us / 1000)} ms old, at most ${maxAge_us / 1000}`);
    return age_us;
  }

  /** Reject requests that cite a status from before this call: before a STOP, a disarm or the loss of a human. */
  denyEarlier() {
    this.deniedSeq = this.lastStatusSeq;
  }

  /** Check the status that a request cites. @throws {WireError} unless it is young and after the last STOP or disarm */
  checkRequest(echo, now_us, maxAge_us) {
    if (echo === null || echo.channel !== "status") throw new WireError("MALFORMED", "a request that permits motion must cite a status");
    this.age_us(echo, now_us, maxAge_us);
    if (echo.seq <= this.deniedSeq) throw new WireError("STALE", "cites a status from before the last STOP or disarm; repeat the request");
  }
}

/** Stores since when the image of a live camera is the same, byte for byte. The noise of a sensor never repeats. */
export class FreshnessRecord {
  constructor() {
    this.jpeg = null;
    this.changed_us = 0;
    this.newest_us = 0;
  }

  /** Record a frame. @param {Uint8Array|null} jpeg null for a source that is not live and may repeat an image */
  add(t_us, jpeg) {
    const repeated = jpeg !== null && this.jpeg !== null && jpeg.length === this.jpeg.length && jpeg.every((byte, at) => byte === this.jpeg[at]);
    if (!repeated) this.changed_us = t_us;
    this.jpeg = jpeg;
    this.newest_us = t_us;
  }

  unchanged_us() {
    return this.newest_us - this.changed_us;
  }

  /** Return the time at which the image of a frame of `t_us` first appeared. */
  shownSince_us(t_us) {
    return this.jpeg === null ? t_us : Math.min(t_us, this.changed_us);
  }
}

/** Stores since when, and how far, the robot drives by one twist without a header. A pause does not restart it. */
export class RepeatRecord {
  constructor() {
    this.twist = STILL;
    this.since_us = this.driven_m = 0;
  }

  /** Record an accepted twist. @param {import("./limits.mjs").Twist} twist before limits */
  add(twist, now_us) {
    if (twist.linear_mps === this.twist.linear_mps && twist.angular_rad_s === this.twist.angular_rad_s) return;
    this.twist = twist;
    this.since_us = now_us;
    this.driven_m = 0;
  }

  drive(linear_mps, elapsed_us) {
    this.driven_m += (Math.abs(linear_mps) * elapsed_us) / 1e6;
  }

  /** Return true after too long without a change, which alone shows that the sender has a new image. */
  isOver({ guestUnchanged_us, guestUnchanged_m }, now_us) {
    const isLong = now_us - this.since_us > guestUnchanged_us || this.driven_m > guestUnchanged_m;
    return isLong && !isStill(this.twist);
  }
}

/** Stores the newest seq of each (source, session), for a bounded number of senders. Rejected senders evict no driver. */
export class SequenceRecord {
  constructor() {
    this.drivers = new Map();
    this.others = new Map();
  }

  /** Store the seq of a command. @throws {WireError} OUT_OF_ORDER if it is not the newest, or jumps too far */
  check({ source, session, seq }, now_us) {
    const sender = `${source}/${session}`;
    const table = this.drivers.has(sender) ? this.drivers : this.others;
    const entry = table.get(sender);
    const last = entry !== undefined && now_us - entry.now_us <= SENDER_MEMORY_US ? entry.seq : -1;
    if (seq <= last) throw new WireError("OUT_OF_ORDER", `seq ${seq} of ${source} is not newer than ${last}`);
    if (seq > (last < 0 ? MAX_FIRST_SEQ : last + MAX_SEQ_JUMP)) throw new WireError("OUT_OF_ORDER", `seq ${seq} of ${source} jumps too far`);
    store(table, sender, { seq, now_us });
  }

  /** Store a sender with the drivers: its last command took or renewed the lease. */
  promote({ source, session }) {
    const sender = `${source}/${session}`;
    const entry = this.others.get(sender);
    if (entry === undefined) return;
    this.others.delete(sender);
    store(this.drivers, sender, entry);
  }
}

function store(table, sender, entry) {
  table.delete(sender);
  table.set(sender, entry);
  if (table.size > KEPT_SENDERS) table.delete(table.keys().next().value);
}

/** The right to drive: one driver at a time, by rank, while its commands are accepted. */
export class Lease {
  /** @param {number} life_us */
  constructor(life_us) {
    this.life_us = life_us;
    this.drop();
  }

  /** Return the driver that holds the lease now. @returns {Holder|null} */
  liveHolder(now_us) {
    return now_us < this.expires_us ? this.holder : null;
  }

  mayTake(sender, now_us) {
    const holder = this.liveHolder(now_us);
    return holder === null || isSame(holder, sender) || RANKS[sender.source] > RANKS[holder.source];
  }

  /** Check that a message which names the holder is of the holder. @throws {WireError} NOT_PROVEN */
  checkProof(sender, proof, now_us, isNeeded = false) {
    if (isNeeded && proof.proof === null) throw new WireError("NOT_PROVEN", "a robot with keys needs a proof in each command");
    if (!isSame(this.liveHolder(now_us), sender) || this.proof.proof === null || continues(proof.proof, this.proof)) return;
    throw new WireError("NOT_PROVEN", `its proof does not continue that of the ${sender.source} that drives`);
  }

  /** Store the proof of a request of the holder, so that no copy of it proves anything. */
  advance(sender, proof, now_us) {
    if (isSame(this.liveHolder(now_us), sender)) this.proof = proof;
  }

  take(sender, now_us, proof = NO_PROOF) {
    this.holder = sender;
    this.proof = proof;
    this.expires_us = now_us + this.life_us;
  }

  drop() {
    this.holder = null;
    this.proof = NO_PROOF;
    this.expires_us = 0;
  }

  /** Return true if a human held the lease and it expired. */
  lostHuman(now_us) {
    return this.holder !== null && isHuman(this.holder.source) && now_us >= this.expires_us;
  }
}
