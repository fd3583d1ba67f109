/**
 * @file Serve the viewer page for a robot without one, and forward its WebSocket, on one port of loopback. Shell.
 *
 *     node examples/js/gateway.mjs --connect ws://127.0.0.1:9090 --robot r1 --port 8765
 *
 * A robot admits only pages of its own host and port, so page and WebSocket must have one origin. The robot still checks
 * `Host`, `Origin` and token, because the gateway forwards them unchanged.
 */

import { createServer } from "node:http";
import { connect } from "node:net";
import { parseArgs } from "node:util";
import { servePage } from "./pages.mjs";
import { OPEN_MS, admissionProblem } from "./websocket.mjs";

const USAGE = "node gateway.mjs --connect ws://HOST:PORT --robot ID [--port 8765]";
const HOST = "127.0.0.1"; // loopback only: to the robot, each client of the gateway is on this machine
const MAX_SOCKETS = 32; // security limit, as of a robot
const KEEP_ALIVE_MS = 1000;

class UsageError extends Error {}

const isPort = (number) => Number.isInteger(number) && number >= 1 && number <= 65_535;

function readOptions() {
  const text = { type: "string" };
  const { values } = parseArgs({ options: { connect: text, robot: text, port: { ...text, default: "8765" } } });
  const found = /^ws:\/\/(\[[0-9a-fA-F:]+\]|[^:/?#]+):([0-9]{1,5})\/?$/.exec(values.connect ?? "");
  if (found === null || !isPort(Number(found[2]))) throw new UsageError("invalid --connect: expected ws://HOST:PORT of the robot");
  if (!/^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$/.test(values.robot ?? "")) throw new UsageError("invalid --robot: expected 1 to 32 letters, digits, _ . -");
  const port = Number(values.port);
  if (!isPort(port)) throw new UsageError("invalid --port: expected 1 to 65535");
  return { robot: values.robot, port, to: { host: found[1].replace(/^\[|\]$/g, ""), port: Number(found[2]) } };
}

/** Write the request as received, so that the robot can validate it. */
function rawRequest({ method, url, rawHeaders }) {
  const lines = [];
  for (let at = 0; at < rawHeaders.length; at += 2) lines.push(`${rawHeaders[at]}: ${rawHeaders[at + 1]}\r\n`);
  return `${method} ${url} HTTP/1.1\r\n${lines.join("")}\r\n`;
}

/** Connect two sockets, each at the rate at which the other reads. */
function connectBoth(client, upstream) {
  for (const [from, to] of [[client, upstream], [upstream, client]]) {
    from.setNoDelay(true);
    from.setKeepAlive(true, KEEP_ALIVE_MS); // an end that loses its power does not close
    from.on("error", () => to.destroy());
    from.on("close", () => to.destroy());
    from.pipe(to);
  }
}

function forward(to) {
  return (request, client, head) => {
    const problem = admissionProblem(request.rawHeaders, HOST);
    const reject = ([status, line]) => client.end(`HTTP/1.1 ${status} Rejected\r\nConnection: close\r\n\r\n${line}\n`);
    client.on("error", () => client.destroy());
    if (problem !== null) return reject(problem);
    const upstream = connect(to).setTimeout(OPEN_MS, () => upstream.destroy(new Error("no connection in time")));
    upstream.once("error", () => reject([502, "the robot does not answer"]));
    upstream.once("connect", () => {
      upstream.setTimeout(0);
      upstream.removeAllListeners("error");
      upstream.write(rawRequest(request));
      upstream.write(head);
      connectBoth(client, upstream);
    });
  };
}

try {
  const { robot, port, to } = readOptions();
  const server = createServer({ headersTimeout: OPEN_MS, requestTimeout: OPEN_MS, connectionsCheckingInterval: 500, maxHeaderSize: 8192 }, servePage(HOST, robot));
  server.maxConnections = MAX_SOCKETS;
  server.on("upgrade", forward(to));
  server.once("error", ({ code, message }) => {
    console.error(`error: ${code === "EADDRINUSE" ? "the port is in use; choose another --port" : message}`);
    process.exit(4);
  });
  server.listen(port, HOST, () => console.log(`gateway: viewer of robot ${robot} at http://${HOST}:${port}/`));
  for (const signal of ["SIGINT", "SIGTERM", "SIGHUP"]) process.once(signal, () => process.exit(0));
} catch (error) {
  if (!(error instanceof UsageError || String(error.code).startsWith("ERR_PARSE_ARGS"))) throw error;
  console.error(`error: ${error.message}\nusage: ${USAGE}`);
  process.exit(2);
}
