/**
 * @file The STOP port of a robot: STOP datagrams in, answers out (clause 20), without a STOP secret. Pure.
 *
 * Any peer that reaches the port can stop the robot. With a secret, each datagram needs an HMAC (20.5); this has none.
 */

import { WireError } from "./codec.mjs";
import { isStill } from "./limits.mjs";

export const DATAGRAM_BYTES = 112;
const STATES = ["", "DISARMED", "HOLD", "ACTIVE", "DEGRADED", "STOPPED", "FAULT"];
const [VERSION, STOP, ANSWER] = [1, 1, 2];
const AT = { version: 4, kind: 5, state: 6, flags: 7, robot: 8, counter: 40, challenge: 48, received: 64, applied: 72 };
const [AT_REST, STORED] = [1, 2];

/** Answers the STOPs of one robot. The caller owns the socket and stores the latch. */
export class StopPort {
  /** @param {string} robot its id @param {object} gate of the robot @param {Uint8Array} challenge 16 random bytes */
  constructor(robot, gate, challenge) {
    this.robot = Buffer.alloc(AT.counter - AT.robot);
    this.robot.write(robot, "ascii");
    this.gate = gate;
    this.challenge = challenge;
    this.received = 0;
  }

  /**
   * Latch STOPPED, or ignore and count the datagram.
   * @param {Buffer} data
   * @returns {boolean} true for a valid STOP, which the caller must answer
   */
  onDatagram(data) {
    try {
      this.check(data);
    } catch (error) {
      this.gate.count(error.reason);
      return false;
    }
    this.received += 1;
    this.gate.stop("STOP by UDP");
    return true;
  }

  check(data) {
    if (data.length !== DATAGRAM_BYTES || data.toString("latin1", 0, AT.version) !== "STOP") throw new WireError("MALFORMED", "no STOP datagram");
    if (data[AT.version] !== VERSION) throw new WireError("UNSUPPORTED_VERSION", `version ${data[AT.version]}, expected ${VERSION}`);
    if (data[AT.kind] !== STOP || data[AT.state] >= STATES.length) throw new WireError("MALFORMED", "not a STOP");
    if (!data.subarray(AT.robot, AT.counter).equals(this.robot)) throw new WireError("OTHER_ROBOT", "a STOP for another robot");
  }

  /** Return the answer to a STOP. @param {Buffer} data @param {boolean} isStored true if the latch is on disk */
  answer(data, isStored) {
    const answer = Buffer.alloc(DATAGRAM_BYTES);
    data.copy(answer, 0, 0, AT.kind);
    answer[AT.kind] = ANSWER;
    answer[AT.state] = STATES.indexOf(this.gate.state);
    answer[AT.flags] = (isStill(this.gate.applied) ? AT_REST : 0) | (isStored ? STORED : 0);
    this.robot.copy(answer, AT.robot);
    data.copy(answer, AT.counter, AT.counter, AT.challenge);
    answer.set(this.challenge, AT.challenge);
    answer.writeBigUInt64BE(BigInt(this.received), AT.received);
    answer.writeBigUInt64BE(BigInt(this.received), AT.applied); // applied at once: there is one process
    return answer;
  }
}
