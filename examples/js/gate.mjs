/**
 * @file The gate: the only path from a command to the wheels. Contains state, lease and STOP latch. Pure.
 *
 * `offer` validates a command once, on arrival. `step` checks its age again at each tick and computes the twist.
 */

import { WireError } from "./codec.mjs";
import { LIMITS, Ramp, STILL, ageFactor, clampTwist, isStill } from "./limits.mjs";
import { FreshnessRecord, IssuedRecord, Lease, RANKS, RepeatRecord, SequenceRecord, isHuman, isSame, proofOf, publicHolder } from "./validation.mjs";

const MAX_REQUEST_AGE_US = 2_000_000;
const GUEST = Object.freeze({ source: "guest", session: "00000000" }); // the sender of every twist without a header
const ARMED = ["HOLD", "ACTIVE", "DEGRADED"];
const ALWAYS_GRANTED = ["stop", "disarm"];

export class Gate {
  /**
   * @param {string} session 8 hex digits, new at each start
   * @param {Partial<typeof LIMITS>} limits
   * @param {boolean} stopped true if the STOP latch was set before the restart
   */
  constructor(session, limits = {}, stopped = false) {
    this.limits = { ...LIMITS, ...limits };
    this.issued = new IssuedRecord(session);
    this.freshness = new FreshnessRecord();
    this.repeats = new RepeatRecord();
    this.sequence = new SequenceRecord();
    this.lease = new Lease(this.limits.lease_us);
    this.ramp = new Ramp(this.limits);
    this.state = stopped ? "STOPPED" : "DISARMED";
    this.reason = stopped ? "STOP was set before the restart" : "not armed";
    this.armsItself = this.limits.autoArm && !stopped;
    this.command = null; // {twist, echo_us, arrival_us, life_us, citesFrame}
    this.liveCommands = this.accepted = this.holdSince_us = 0;
    this.lastStep_us = null;
    this.counters = {};
    this.lastRejection = this.latency_us = null;
  }

  get armed() {
    return ARMED.includes(this.state);
  }

  get applied() {
    return this.ramp.twist;
  }

  // --- commands ------------------------------------------------------------------------------------------------

  /**
   * Validate one command on arrival. Counts each rejection and stores the newest.
   * @param {string} source role in the key of the message
   * @param {object|null} header null for a guest without a header
   * @param {import("./limits.mjs").Twist} twist
   * @param {number} now_us
   * @returns {string|null} the reason of a rejection, or null if the command was accepted
   */
  offer(source, header, twist, now_us) {
    try {
      const { sender, age_us } = this.identify(source, header, now_us);
      this.admit(sender, header, now_us);
      this.accept(header, twist, now_us, age_us);
      this.accepted += 1;
      return null;
    } catch (error) {
      return this.reject(source, error);
    }
  }

  /** Count a rejection. Rethrow any error but a {@link WireError}, which is a fault of this program. */
  reject(source, error) {
    if (!(error instanceof WireError)) throw error;
    this.count(error.reason);
    this.lastRejection = { source: source.slice(0, 32), reason: error.reason, detail: error.message };
    return error.reason;
  }

  count(reason) {
    this.counters[reason] = (this.counters[reason] ?? 0) + 1;
  }

  /** Return the sender, and the age of the cited frame (steps 2 to 6 of the validation). @throws {WireError} */
  identify(source, header, now_us) {
    if (!(source in RANKS) || (header !== null && header.source !== source)) {
      throw new WireError("UNKNOWN_SOURCE", `unknown source ${source}, or different from the header`);
    }
    if (source === "guest" && !this.limits.guests) throw new WireError("UNKNOWN_SOURCE", "guests are switched off (--guests)");
    if (header === null) return { sender: GUEST, age_us: 0 };
    if (header.echo.session === this.issued.session && header.echo.channel === "status") {
      throw new WireError("UNKNOWN_FRAME", "a twist must cite a frame, not a status");
    }
    this.issued.age_us(header.echo, now_us, this.limits.zeroSpeedAge_us);
    const age_us = now_us - this.freshness.shownSince_us(header.echo.t_us);
    if (age_us > this.limits.zeroSpeedAge_us) throw new WireError("STALE", "the camera image does not change");
    const sender = { source, session: header.session };
    this.lease.checkProof(sender, proofOf(header), now_us, this.limits.needsProof);
    this.sequence.check(header, now_us);
    return { sender, age_us };
  }

  /** Check the latch, the lease and the arming (steps 7 to 9). @throws {WireError} */
  admit(sender, header, now_us) {
    if (this.state === "STOPPED") throw new WireError(this.state, this.reason);
    this.noticeLostHuman(now_us);
    const holder = this.lease.liveHolder(now_us);
    if (!this.lease.mayTake(sender, now_us)) throw new WireError("NOT_HOLDER", `${holder.source} ${publicHolder(holder).digest} drives`);
    this.liveCommands = isSame(holder, sender) ? this.liveCommands + 1 : 1;
    this.lease.take(sender, now_us, proofOf(header));
    this.sequence.promote(sender);
    if (!this.armed) throw new WireError("DISARMED", this.reason);
  }

  accept(header, twist, now_us, age_us) {
    const limits = this.limits;
    const guest = header === null || header.source === "guest";
    const maxLinear_mps = guest ? Math.min(limits.maxLinear_mps, limits.guestMaxLinear_mps) : limits.maxLinear_mps;
    const maxAngular_rad_s = guest ? Math.min(limits.maxAngular_rad_s, limits.guestMaxAngular_rad_s) : limits.maxAngular_rad_s;
    const limited = clampTwist(twist, maxLinear_mps, maxAngular_rad_s);
    if (limited !== twist) this.count("CLAMPED");
    const life_us = guest ? limits.guestLife_us : limits.silence_us;
    if (header === null) this.repeats.add(twist, now_us);
    this.command = { twist: limited, echo_us: now_us - age_us, arrival_us: now_us, life_us, citesFrame: header !== null };
    if (!guest) this.latency_us = age_us;
  }

  // --- the wheels ----------------------------------------------------------------------------------------------

  /** Compute the twist from now until the next step. @returns {import("./limits.mjs").Twist} */
  step(now_us) {
    this.noticeLostHuman(now_us);
    if (this.armsItself && this.state === "DISARMED" && this.missingToArm(now_us) === "") {
      this.begin("armed by itself (--auto-arm)", now_us);
    }
    const goal = this.armed ? this.goal(now_us) : STILL;
    const elapsed_us = Math.max(0, now_us - (this.lastStep_us ?? now_us));
    this.lastStep_us = now_us;
    this.repeats.drive(this.applied.linear_mps, elapsed_us);
    return this.ramp.step(goal, elapsed_us);
  }

  goal(now_us) {
    const { command, limits } = this;
    if (this.freshness.unchanged_us() > limits.zeroSpeedAge_us) return this.hold("the camera image does not change", now_us);
    if (command === null) return this.hold("armed; no command yet", now_us);
    if (now_us - command.arrival_us > command.life_us) {
      return this.hold(`no accepted command for more than ${command.life_us / 1000} ms`, now_us);
    }
    if (!command.citesFrame && this.repeats.isOver(limits, now_us)) return this.hold("the same command without a frame for too long", now_us);
    const factor = ageFactor(limits, now_us - command.echo_us);
    if (factor === 0) return this.hold("the frame behind the command is too old", now_us);
    this.state = factor === 1 ? "ACTIVE" : "DEGRADED";
    this.reason = factor === 1 ? "driving" : "the frame is aging; slower";
    return clampTwist(command.twist, factor * limits.maxLinear_mps, factor * limits.maxAngular_rad_s);
  }

  hold(reason, now_us) {
    if (this.state !== "HOLD") this.holdSince_us = now_us;
    this.state = "HOLD";
    this.reason = reason;
    if (now_us - this.holdSince_us > this.limits.disarmAfterHold_us) {
      this.leave("DISARMED", "disarmed after 10 s without commands", this.armsItself);
    }
    return STILL;
  }

  // --- requests ------------------------------------------------------------------------------------------------

  /**
   * Carry out a request.
   * @param {{source: string, session: string, echo: object|null}} header @param {string} verb
   * @returns {string} one line for the operator
   * @throws {WireError} if the request is rejected
   */
  request(header, verb, now_us) {
    const sender = { source: header.source, session: header.session };
    if (!ALWAYS_GRANTED.includes(verb) && verb !== "release") this.issued.checkRequest(header.echo, now_us, MAX_REQUEST_AGE_US);
    this.noticeLostHuman(now_us);
    if (!ALWAYS_GRANTED.includes(verb)) {
      this.lease.checkProof(sender, proofOf(header), now_us, this.limits.needsProof && verb === "acquire");
      this.lease.advance(sender, proofOf(header), now_us);
    }
    switch (verb) {
      case "stop":
        return this.stop(`STOP by ${sender.source}`);
      case "disarm":
        return this.disarm(`disarmed by ${sender.source}`);
      case "release":
        return this.release(sender, now_us);
      case "acquire":
        return this.acquire(sender, now_us, proofOf(header));
      case "reset":
        return this.reset(sender, now_us);
      default:
        return this.arm(sender, now_us);
    }
  }

  /** Latch STOPPED. The wheels ramp to zero and stay there until `reset`. Always granted. */
  stop(reason) {
    this.issued.denyEarlier();
    this.leave("STOPPED", reason);
    return "STOPPED";
  }

  disarm(reason) {
    this.issued.denyEarlier();
    this.armsItself = false;
    if (this.armed) this.leave("DISARMED", reason);
    return "disarmed";
  }

  reset(sender, now_us) {
    this.rejectBesideHuman(sender, now_us);
    if (this.state !== "STOPPED") return `nothing to reset: ${this.state}`;
    if (!isStill(this.applied)) throw new WireError("NOT_ALLOWED", "the wheels are not at zero yet; repeat the request");
    this.leave("DISARMED", `reset by ${sender.source}; not armed`);
    return "reset; arm to drive";
  }

  arm(sender, now_us) {
    this.rejectBesideHuman(sender, now_us);
    if (this.armed) return "already armed";
    if (this.state !== "DISARMED") throw new WireError(this.state, `${this.reason}; reset first`);
    const missing = this.missingToArm(now_us);
    if (missing !== "") throw new WireError("NOT_ALLOWED", missing);
    this.armsItself = this.limits.autoArm;
    this.repeats = new RepeatRecord(); // an operator who arms has looked at the robot
    this.begin(`armed by ${sender.source}`, now_us);
    return "armed";
  }

  acquire(sender, now_us, proof) {
    const holder = this.lease.liveHolder(now_us);
    if (!(sender.source in RANKS) || !this.lease.mayTake(sender, now_us)) {
      throw new WireError("NOT_HOLDER", holder ? `${holder.source} drives` : `${sender.source} may not drive`);
    }
    if (isSame(holder, sender)) return "already held";
    this.liveCommands = 0;
    this.command = null; // commands of the previous driver must not move the robot for the new one
    this.lease.take(sender, now_us, proof);
    return "acquired";
  }

  release(sender, now_us) {
    if (!isSame(this.lease.liveHolder(now_us), sender)) return "not held";
    this.lease.drop();
    this.command = null;
    if (isHuman(sender.source)) this.loseHuman("the operator released control; arm again");
    return "released";
  }

  frameAge_us(now_us) {
    return this.command?.citesFrame ? Math.max(0, now_us - this.command.echo_us) : null;
  }

  rejectBesideHuman(sender, now_us) {
    const holder = this.lease.liveHolder(now_us);
    if (holder !== null && isHuman(holder.source) && !isSame(holder, sender)) {
      throw new WireError("NOT_ALLOWED", `${holder.source} ${publicHolder(holder).digest} drives`);
    }
  }

  /** Return the condition that still prevents arming, or "". */
  missingToArm(now_us) {
    const needed = this.limits.liveCommandsToArm;
    if (this.lease.liveHolder(now_us) === null) return "no valid commands yet; start the vision service";
    if (this.liveCommands < needed) return `${this.liveCommands} of ${needed} live commands received; repeat the request`;
    return isStill(this.applied) ? "" : "the wheels are not at zero yet; repeat the request";
  }

  noticeLostHuman(now_us) {
    if (!this.lease.lostHuman(now_us)) return;
    this.lease.drop();
    this.loseHuman("the operator who drove was lost; arm again");
  }

  loseHuman(reason) {
    this.issued.denyEarlier();
    this.armsItself = false;
    if (this.armed) this.leave("DISARMED", reason);
  }

  begin(reason, now_us) {
    this.command = null;
    this.holdSince_us = now_us;
    this.state = "HOLD";
    this.reason = reason;
  }

  /** Go to a state with the wheels off. `armsItself`: the robot may arm later without an operator. */
  leave(state, reason, armsItself = false) {
    this.state = state;
    this.reason = reason;
    this.command = null;
    this.liveCommands = 0;
    this.armsItself = armsItself;
  }
}
