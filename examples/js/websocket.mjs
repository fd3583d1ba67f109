/**
 * @file WebSocket on `http` and `net` of Node: server, client, and one open connection. Shell.
 *
 * Node 20 has a WebSocket only behind a flag. A browser has its own.
 */

import { createHash, randomBytes, timingSafeEqual } from "node:crypto";
import { createServer, request as httpRequest } from "node:http";
import { createServer as createTlsServer, request as httpsRequest } from "node:https";
import { isIP } from "node:net";
import { MAX_HELLO_BYTES, PeerError, SUBPROTOCOL } from "./framing.mjs";
import { FrameReader, OPCODE, closePayload, encodeFrame } from "./rfc6455.mjs";

const GUID = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"; // RFC 6455, 1.3
const PING_MS = 1000; // silence of the other end before a ping
const SILENT_MS = 2000;
const STALLED_MS = 30_000; // for the end of a message that the other machine takes slowly, or never
const CHECK_MS = 250;
const CLOSE_MS = 1000;
export const OPEN_MS = 2000; // security limit: for the HTTP handshake, and again for the hello
const MAX_CLIENTS = 16; // security limit, of the protocol
const MAX_SOCKETS = 32; // security limit: clients and unfinished handshakes
const EMPTY = new Uint8Array(0);

/** An open connection: receives whole messages, sends the newest of each channel, pings and closes. */
export class Connection {
  /**
   * @param {import("node:net").Socket} socket
   * @param {boolean} listening true for the server
   */
  constructor(socket, listening) {
    this.socket = socket;
    this.listening = listening;
    this.reader = new FrameReader({ masked: listening, maxBytes: MAX_HELLO_BYTES });
    this.next = () => undefined; // returns the next message to send, when the kernel has room
    this.onMessage = () => undefined;
    this.onEnd = () => undefined;
    this.writing = this.closing = this.pinged = this.pingDue = false;
    this.received_ms = performance.now();
    this.began_ms = this.waited_ms = -Infinity; // the newest write, and the newest one that had to wait for room
    this.pong = null; // answers only the newest ping: a client that pings and never reads fills no memory
    socket.setNoDelay(true);
    socket.on("data", (chunk) => this.read(chunk));
    socket.on("error", () => socket.destroy());
    socket.on("end", () => socket.destroy());
    socket.on("close", () => this.onClosed());
    this.checks = setInterval(() => this.check(), CHECK_MS);
  }

  read(chunk) {
    this.received_ms = performance.now();
    this.waited_ms = -Infinity;
    this.pinged = false;
    try {
      for (const event of this.reader.feed(chunk)) this.onEvent(event);
    } catch (error) {
      if (!(error instanceof PeerError)) console.error(`error: exception while reading a message: ${error.stack}`);
      const ours = { code: 1011, message: "internal error" }; // ends one connection, not the robot
      const { code, message } = error instanceof PeerError ? error : ours;
      this.close(code, message);
    }
  }

  onEvent({ kind, data, code }) {
    if (kind === "close") this.onClose(code, data);
    else if (this.closing || kind === "pong") return;
    else if (kind === "ping") this.answerPing(data);
    else this.onMessage(data);
  }

  onClose(code, reason) {
    this.reason ??= { code, reason };
    if (!this.closing) this.write(OPCODE.CLOSE, code === 1005 ? EMPTY : closePayload(code, ""));
    this.end(CLOSE_MS);
  }

  answerPing(data) {
    this.pong = data;
    this.pump();
  }

  /**
   * Ping a silent end. Any bytes that it sends prove that it is alive. An end for which a write waits is slow, not gone.
   * So is an end that has not read that write yet: it receives the ping only after it.
   */
  check() {
    const now_ms = performance.now();
    if (this.writing) this.waited_ms = this.began_ms;
    const isSlow = now_ms - this.waited_ms < STALLED_MS;
    if (now_ms - this.received_ms >= SILENT_MS && !isSlow) this.close(1011, "silent for too long");
    if (now_ms - this.received_ms < PING_MS || this.pinged) return;
    this.pinged = this.pingDue = true;
    this.pump();
  }

  /** Send the waiting messages one at a time, each after the kernel took the previous one. */
  pump() {
    if (this.writing || this.closing) return;
    const [opcode, payload] = this.nextFrame();
    if (payload === undefined) return;
    this.writing = true;
    this.began_ms = performance.now();
    this.write(opcode, payload, () => {
      this.writing = false;
      this.pump();
    });
  }

  nextFrame() {
    const { pong, pingDue } = this;
    this.pong = null;
    if (pong !== null) return [OPCODE.PONG, pong];
    this.pingDue = false;
    if (pingDue) return [OPCODE.PING, EMPTY];
    const message = this.next();
    return typeof message === "string" ? [OPCODE.TEXT, Buffer.from(message)] : [OPCODE.BINARY, message];
  }

  write(opcode, payload, done) {
    if (this.socket.writable) this.socket.write(encodeFrame(opcode, payload, this.listening ? null : randomBytes(4)), done);
  }

  /** Send a close frame. The socket ends within a second. */
  close(code, reason) {
    if (this.closing) return;
    this.reason = { code, reason };
    this.write(OPCODE.CLOSE, closePayload(code, reason));
    this.reader.feed = function* nothing() {}; // read nothing after a protocol error
    this.end(code === 1001 ? CLOSE_MS : CLOSE_MS / 2);
  }

  /** Let written bytes leave for this time, then destroy the socket. */
  end(within_ms) {
    this.closing = true;
    setTimeout(() => this.socket.destroy(), within_ms).unref();
    this.socket.end();
  }

  onClosed() {
    clearInterval(this.checks);
    this.closing = true;
    this.onEnd(this.reason ?? { code: 1006, reason: "the connection broke" });
  }
}

/**
 * Return the reason to reject a request as [HTTP status, one line], or null.
 *
 * A page of a foreign site can reach this machine with a DNS name that the site owns. Valid names are therefore addresses,
 * names without a dot, names in `.local`, and the name on which the server listens.
 * @param {string[]} rawHeaders @param {string} listenHost
 */
export function admissionProblem(rawHeaders, listenHost) {
  const all = (name) => rawHeaders.filter((_, index) => index % 2 === 1 && rawHeaders[index - 1].toLowerCase() === name);
  const [hosts, origins] = [all("host"), all("origin")];
  const host = (hosts[0] ?? "").toLowerCase();
  const name = host.replace(/:[0-9]+$/, "").replace(/^\[|\]$/g, "");
  const local = !name.includes(".") || name.endsWith(".local") || name === listenHost.toLowerCase() || isIP(name) !== 0;
  if (hosts.length !== 1 || name === "" || !local) return [403, `Host ${host.slice(0, 80)} is not this machine`];
  const own = [`http://${host}`, `https://${host}`];
  if (origins.length > 1 || (origins.length === 1 && !own.includes(origins[0].toLowerCase()))) {
    return [403, `Origin ${origins[0].slice(0, 80)} differs from Host ${host}`];
  }
  return null;
}

const TOKEN_ENTRY = "sightline.token."; // in the list of sub-protocols, the only header that a page can set

/** Return true if a request has this token and no other, in its sub-protocols or as `Authorization: Bearer`. */
function hasToken(headers, offered, token) {
  const tokens = offered.filter((name) => name.startsWith(TOKEN_ENTRY)).map((name) => name.slice(TOKEN_ENTRY.length));
  const bearer = /^Bearer +(\S+)$/i.exec(headers.authorization ?? "");
  if (bearer !== null) tokens.push(bearer[1]);
  const digest = (text) => createHash("sha256").update(text).digest(); // of equal length, as the comparison requires
  return tokens.length === 1 && timingSafeEqual(digest(tokens[0]), digest(token));
}

function upgradeProblem(request, token) {
  const { headers } = request;
  const offered = (headers["sec-websocket-protocol"] ?? "").split(",").map((name) => name.trim());
  if (headers["sec-websocket-version"] !== "13") return [426, "unsupported WebSocket version; use 13"];
  if (request.method !== "GET" || !/^[A-Za-z0-9+/]{22}==$/.test(headers["sec-websocket-key"] ?? "")) return [400, "invalid WebSocket handshake"];
  if (!offered.includes(SUBPROTOCOL)) return [400, `offer the sub-protocol ${SUBPROTOCOL}`];
  return token === undefined || hasToken(headers, offered, token) ? null : [401, "missing or wrong token; send the token of this robot"];
}

const acceptKey = (key) => createHash("sha1").update(key + GUID).digest("base64");

function rejectUpgrade(socket, [status, line]) {
  const version = status === 426 ? "Sec-WebSocket-Version: 13\r\n" : "";
  socket.on("error", () => socket.destroy());
  socket.end(`HTTP/1.1 ${status} Rejected\r\n${version}Connection: close\r\nContent-Type: text/plain\r\nContent-Length: ${line.length + 1}\r\n\r\n${line}\n`);
}

/**
 * Listen for peers.
 * @param {{host: string, port: number, token?: string, tls?: {cert: Buffer, key: Buffer}, onConnection: (connection: Connection) => void,
 *   onPage: (request: object, response: object) => void}} options
 * @returns {Promise<import("node:http").Server>} with `closeAll(reason)`; rejects if the port is not available
 */
export function listen({ host, port, token, tls, onConnection, onPage }) {
  const open = new Set();
  const limits = { headersTimeout: OPEN_MS, requestTimeout: OPEN_MS, connectionsCheckingInterval: 500, maxHeaderSize: 8192, handshakeTimeout: OPEN_MS };
  const server = tls ? createTlsServer({ ...limits, ...tls }, onPage) : createServer(limits, onPage);
  server.maxConnections = MAX_SOCKETS;
  server.on("upgrade", (request, socket, head) => {
    const full = open.size >= MAX_CLIENTS ? [503, `${MAX_CLIENTS} clients are connected, which is the limit`] : null;
    const problem = admissionProblem(request.rawHeaders, host) ?? full ?? upgradeProblem(request, token);
    if (problem !== null) return rejectUpgrade(socket, problem);
    const accept = acceptKey(request.headers["sec-websocket-key"]);
    socket.write(`HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: ${accept}\r\nSec-WebSocket-Protocol: ${SUBPROTOCOL}\r\n\r\n`);
    const connection = new Connection(socket, true);
    open.add(connection);
    socket.on("close", () => open.delete(connection));
    onConnection(connection);
    if (head.length > 0) connection.read(head);
  });
  server.closeAll = (reason) => {
    server.close();
    for (const connection of open) connection.close(1001, reason);
  };
  return new Promise((resolve, reject) => server.once("error", reject).listen(port, host, () => resolve(server)));
}

/**
 * Connect to `ws://host:port` or `wss://host:port`.
 * @param {string} url @param {{token?: string, ca?: Buffer}} [keys] token of the robot, and the authority of its certificate
 * @returns {Promise<Connection>} rejects with one line for the operator
 */
export function connect(url, { token, ca } = {}) {
  const { hostname, port, protocol } = new URL(url);
  const open = protocol === "wss:" ? httpsRequest : httpRequest;
  const key = randomBytes(16).toString("base64");
  const headers = {
    Connection: "Upgrade", Upgrade: "websocket", "Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": key, "Sec-WebSocket-Protocol": SUBPROTOCOL,
    ...(token ? { Authorization: `Bearer ${token}` } : {}),
  };
  return new Promise((resolve, reject) => {
    const request = open({ ca, host: hostname.replace(/^\[|\]$/g, ""), port, headers });
    const timeout = setTimeout(() => request.destroy(new Error("no answer within 2 s")), OPEN_MS);
    request.on("close", () => clearTimeout(timeout));
    request.on("error", reject);
    request.on("response", (response) => {
      response.on("data", (body) => reject(new Error(String(body).trim().slice(0, 200)))).on("end", () => reject(new Error(`HTTP ${response.statusCode}`)));
    });
    request.on("upgrade", (response, socket, head) => {
      const isValid = response.headers["sec-websocket-accept"] === acceptKey(key) && response.headers["sec-websocket-protocol"] === SUBPROTOCOL;
      if (!isValid) return socket.destroy(reject(new Error(`the service there does not support ${SUBPROTOCOL}`)));
      const connection = new Connection(socket, false);
      resolve(connection);
      if (head.length > 0) setImmediate(() => connection.read(head)); // after the caller has set its callbacks
    });
    request.end();
  });
}
