/**
 * @file One peer of `sightline.v1` on an open connection: a hello, then the newest message of each channel. Shell.
 */

import { OutgoingQueue, PeerError, messageBound, pack, packRaw, readHello, unpack } from "./framing.mjs";
import { OPEN_MS } from "./websocket.mjs";

/** Calls `onMessage({channel, source, header, payload})`, `onOpen()` and `onEnd({code, reason})`. */
export class Peer {
  /**
   * @param {import("./websocket.mjs").Connection} connection
   * @param {{robot: string, hello: string, sendsFirst: boolean, onMessage: Function, onOpen?: Function, onEnd?: Function}} options
   */
  constructor(connection, { robot, hello, sendsFirst, onMessage, onOpen = () => undefined, onEnd = () => undefined }) {
    Object.assign(this, { connection, robot, hello, sendsFirst, onMessage, onOpen });
    this.queue = new OutgoingQueue();
    this.wants = new Set();
    this.role = "";
    this.isOpen = false;
    this.dropped = 0; // messages with an invalid key
    connection.next = () => this.queue.take();
    connection.onMessage = (message) => this.read(message);
    connection.onEnd = (end) => {
      clearTimeout(this.helloTimer);
      this.isOpen = false;
      onEnd(end);
    };
    this.helloTimer = setTimeout(() => connection.close(1008, "no hello within 2 s"), OPEN_MS);
    if (sendsFirst) this.sendHello(hello);
  }

  /** Send a hello, also when `wants` changes. */
  sendHello(hello) {
    this.queue.put("", "", hello);
    this.connection.pump();
  }

  read(message) {
    if (typeof message === "string") {
      this.onHello(message);
      return;
    }
    if (!this.isOpen) throw new PeerError(1003, "the first message must be a hello, as text");
    const packet = unpack(message, this.role, this.robot);
    if (packet === null) this.dropped += 1;
    else this.onMessage(packet);
  }

  onHello(text) {
    const { role, wants } = readHello(text, this.robot);
    this.role = role;
    this.wants = new Set(wants);
    if (this.isOpen) return;
    clearTimeout(this.helloTimer);
    this.isOpen = true;
    this.connection.reader.maxBytes = messageBound(JSON.parse(this.hello).wants);
    if (!this.sendsFirst) this.sendHello(this.hello);
    this.onOpen();
  }

  /**
   * Send the newest message of a channel, if the peer wants it.
   * @param {string} name channel @param {object} header @param {Uint8Array} payload
   */
  send(name, header, payload) {
    const verb = name === "request" ? JSON.parse(new TextDecoder().decode(payload)).verb : "";
    this.enqueue(name, header.source ?? "", () => pack(name, header, payload), verb);
  }

  /** Forward a packet unchanged. */
  relay({ channel, source, header, payload }) {
    this.enqueue(channel.name, source, () => packRaw(channel.name, source, header, payload));
  }

  enqueue(name, source, write, verb = "") {
    if (!this.isOpen || !this.wants.has(name)) return;
    this.queue.put(name, source, write(), verb);
    this.connection.pump();
  }
}
