/**
 * @file What a robot remembers to judge commands by: what it issued, whose seq it saw, who drives. Pure.
 *
 * Nothing here trusts a sender: a frame is known because this robot issued it, and as old as the robot's clock says.
 *
 * @typedef {{source: string, session: string}} Holder
 */

import { WireError } from "./codec.mjs";
import { STILL, isStill } from "./limits.mjs";
import { continues, sessionDigest } from "./proof.mjs";

const KEPT_PER_CHANNEL = 256; // 8 s of 30 fps frames; anything older is STALE long before
const KEPT_SENDERS = 64;
const SENDER_MEMORY_US = 10_000_000;
const MAX_FIRST_SEQ = 2 ** 32;
const MAX_SEQ_JUMP = 2 ** 20;

/** Roles that may drive, by rank. */
export const RANKS = Object.freeze(Object.assign(Object.create(null), { guest: 0, vision: 1, teleop: 2 }));
const NO_PROOF = Object.freeze({ proof: null, next_proof: null });
export const proofOf = (header) => (header === null ? NO_PROOF : { proof: header.proof ?? null, next_proof: header.next_proof ?? null });
/** What others see of a driver: not its session, which a peer could copy. */
export const publicHolder = ({ source, session }) => ({ source, digest: sessionDigest(source, session) });
export const isHuman = (source) => source === "teleop";
export const isSame = (one, other) => one !== null && other !== null && one.source === other.source && one.session === other.session;

/** (channel, seq) -> t_us of what this session of the robot has issued. */
export class IssuedRecord {
  /** @param {string} session */
  constructor(session) {
    this.session = session;
    this.times = { frame: new Map(), status: new Map(), beat: new Map() };
    this.deniedSeq = -1;
    this.lastStatusSeq = -1;
  }

  /** To be told before it is published: nobody may answer what the robot does not know. */
  add(channel, seq, t_us) {
    const times = this.times[channel];
    times.set(seq, t_us);
    if (times.size > KEPT_PER_CHANNEL) times.delete(times.keys().next().value);
    if (channel === "status") this.lastStatusSeq = seq;
  }

  knows(echo) {
    return echo.session === this.session && this.times[echo.channel].get(echo.seq) === echo.t_us;
  }

  /** Age of what `echo` names. @throws {WireError} OTHER_SESSION, UNKNOWN_FRAME, FROM_FUTURE, STALE */
  age_us(echo, now_us, maxAge_us) {
    if (echo.session !== this.session) throw new WireError("OTHER_SESSION", `cites robot session ${echo.session}, this is ${this.session}`);
    if (!this.knows(echo)) throw new WireError("UNKNOWN_FRAME", `cites ${echo.channel} ${echo.seq}, unknown to this robot`);
    const age_us = now_us - echo.t_us;
    if (age_us < 0) throw new WireError("FROM_FUTURE", `cites ${echo.channel} ${echo.seq} from ${-age_us} us ahead`);
    if (age_us > maxAge_us) throw new WireError("STALE", `${echo.channel} ${echo.seq} is ${Math.round(age_us / 1000)} ms old, at most ${maxAge_us / 1000}`);
    return age_us;
  }

  /** Somebody said STOP or disarm: no request may cite a status from before. */
  denyEarlier() {
    this.deniedSeq = this.lastStatusSeq;
  }

  /** @throws {WireError} unless `echo` names a young status from after the last STOP or disarm */
  checkRequest(echo, now_us, maxAge_us) {
    if (echo === null || echo.channel !== "status") throw new WireError("MALFORMED", "a request that permits motion must cite a status");
    this.age_us(echo, now_us, maxAge_us);
    if (echo.seq <= this.deniedSeq) throw new WireError("STALE", "cites a status from before the last STOP or disarm; repeat the request");
  }
}

/** Since when a live camera's picture has been the same, byte for byte: a sensor's noise never repeats. */
export class FreshnessRecord {
  constructor() {
    this.jpeg = null;
    this.changed_us = 0;
    this.newest_us = 0;
  }

  /** @param {Uint8Array|null} jpeg null for a source that is not live, which is never judged */
  add(t_us, jpeg) {
    const repeated = jpeg !== null && this.jpeg !== null && jpeg.length === this.jpeg.length && jpeg.every((byte, at) => byte === this.jpeg[at]);
    if (!repeated) this.changed_us = t_us;
    this.jpeg = jpeg;
    this.newest_us = t_us;
  }

  unchanged_us() {
    return this.newest_us - this.changed_us;
  }

  /** Since when has been seen what a frame of `t_us` shows. */
  shownSince_us(t_us) {
    return this.jpeg === null ? t_us : Math.min(t_us, this.changed_us);
  }
}

/** Since when, and how far, the robot drives by one twist without a header. Only another twist starts it again, no pause. */
export class RepeatRecord {
  constructor() {
    this.twist = STILL;
    this.since_us = this.driven_m = 0;
  }

  /** @param {import("./limits.mjs").Twist} twist as it arrived */
  add(twist, now_us) {
    if (twist.linear_mps === this.twist.linear_mps && twist.angular_rad_s === this.twist.angular_rad_s) return;
    this.twist = twist;
    this.since_us = now_us;
    this.driven_m = 0;
  }

  drive(linear_mps, elapsed_us) {
    this.driven_m += (Math.abs(linear_mps) * elapsed_us) / 1e6;
  }

  /** Only a changed twist shows that its sender sees a new picture. */
  isOver({ guestUnchanged_us, guestUnchanged_m }, now_us) {
    const isLong = now_us - this.since_us > guestUnchanged_us || this.driven_m > guestUnchanged_m;
    return isLong && !isStill(this.twist);
  }
}

/** The newest seq of each (source, session); the longest silent sender is forgotten first. Rejected senders displace no driver. */
export class SequenceRecord {
  constructor() {
    this.drivers = new Map();
    this.others = new Map();
  }

  /** @throws {WireError} OUT_OF_ORDER unless newer than all before, and not too far ahead */
  check({ source, session, seq }, now_us) {
    const sender = `${source}/${session}`;
    const table = this.drivers.has(sender) ? this.drivers : this.others;
    const entry = table.get(sender);
    const last = entry !== undefined && now_us - entry.now_us <= SENDER_MEMORY_US ? entry.seq : -1;
    if (seq <= last) throw new WireError("OUT_OF_ORDER", `seq ${seq} of ${source} is not newer than ${last}`);
    if (seq > (last < 0 ? MAX_FIRST_SEQ : last + MAX_SEQ_JUMP)) throw new WireError("OUT_OF_ORDER", `seq ${seq} of ${source} jumps too far`);
    store(table, sender, { seq, now_us });
  }

  /** Its last command took or renewed the lease. */
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

/** Who drives: one at a time, by rank, for as long as its commands are judged good. */
export class Lease {
  /** @param {number} life_us */
  constructor(life_us) {
    this.life_us = life_us;
    this.drop();
  }

  /** @returns {Holder|null} */
  liveHolder(now_us) {
    return now_us < this.expires_us ? this.holder : null;
  }

  mayTake(sender, now_us) {
    const holder = this.liveHolder(now_us);
    return holder === null || isSame(holder, sender) || RANKS[sender.source] > RANKS[holder.source];
  }

  /** @throws {WireError} NOT_PROVEN for a message that states the session of the driver and is not its own */
  checkProof(sender, proof, now_us) {
    if (!isSame(this.liveHolder(now_us), sender) || this.proof.proof === null || continues(proof.proof, this.proof)) return;
    throw new WireError("NOT_PROVEN", `its proof does not continue that of the ${sender.source} that drives`);
  }

  /** The proof of the driver's request is used up. */
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

  /** Whether a human held it and let it run out. */
  lostHuman(now_us) {
    return this.holder !== null && isHuman(this.holder.source) && now_us >= this.expires_us;
  }
}
