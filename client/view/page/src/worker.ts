// The worker with the connection: connects, reconnects with backoff, measures the clock and decodes frames, so that neither the
// network nor a large surface holds up a picture.
import { ClockEstimate } from "./clock.ts";
import type { FromWorker, ToWorker } from "./connection.ts";
import { type Call, Dialer } from "./dialer.ts";
import { decodeBinary } from "./frames.ts";
import type { Link } from "./link.ts";
import { type PageText, ProtocolError, type Seat, type Shape } from "./messages.ts";
import { decodeText, encodeText } from "./protocol.ts";
import { Retry } from "./retry.ts";
import { ShapeOrder } from "./shape_order.ts";

const PING_MS = 500;
/** A host that answers no ping for this long is taken as lost, ms. */
const SILENCE_MS = 8000;
/** The same until the first surface has come, because answers queue behind a download, ms. */
const DOWNLOAD_MS = 60_000;
/** A page that exceeds a limit is closed with this code. */
const POLICY_VIOLATION = 1008;

const scope = self as unknown as {
  postMessage(message: FromWorker, transfer?: Transferable[]): void;
  onmessage: ((event: MessageEvent<ToWorker>) => void) | null;
};
const now = (): number => performance.timeOrigin + performance.now();

let dialer: Dialer | null = null;
let hello: Extract<PageText, { type: "hello" }> | null = null;
let seat: Seat | null = null;
/** The connection, also while it opens. */
let call: Call | null = null;
/** The open connection. */
let link: Link | null = null;
let order = new ShapeOrder(postShape);
let toolsSent_us = Number.NEGATIVE_INFINITY;
let retry = new Retry();
let clock = new ClockEstimate();
let isWelcome = false;
let isOver = false;
let heard_ms = 0;
let hasSurface = false;
let pings = 0;
let refusal: string | null = null;

function send(message: PageText): void {
  link?.sendText(encodeText(message));
}

function end(message: FromWorker): void {
  isOver = true;
  scope.postMessage(message);
  hangUp();
}

/** Closes the connection, without an event. */
function hangUp(): void {
  const closed = call;
  call = link = null;
  closed?.close();
}

function connect(): void {
  if (isOver || hello === null || dialer === null) return;
  isWelcome = hasSurface = false;
  refusal = null;
  clock = new ClockEstimate();
  order = new ShapeOrder(postShape);
  toolsSent_us = Number.NEGATIVE_INFINITY;
  heard_ms = now();
  call = dialer.dial({
    open(opened) {
      link = opened;
      heard_ms = now();
      scope.postMessage({ kind: "transport", name: opened.transport });
      send(hello !== null && "role" in hello ? { ...hello, seat } : hello!);
      ping();
    },
    text: (frame) => take(() => takeText(frame)),
    binary: (frame, isOrdered) => take(() => takeBinary(frame, isOrdered)),
    close: (code, reason) => lose(code, reason),
  });
}

function take(message: () => void): void {
  heard_ms = now();
  try {
    message();
  } catch (error) {
    if (!(error instanceof ProtocolError)) throw error;
    end({ kind: "ended", sentence: `The host sent a message that this page cannot read (${error.message}). Reload the page.` });
  }
}

/** Handles a lost connection; `code` is null unless the host closed it. */
function lose(code: number | null, reason: string): void {
  call = link = null;
  if (isOver) return;
  if (code === POLICY_VIOLATION) {
    end({ kind: "ended", sentence: reason || "The host closed the connection because the page exceeded a limit." });
    return;
  }
  const wait = retry.next(now());
  if (wait === null) {
    end({ kind: "ended", sentence: refusal ?? "The host could not be reached for 60 seconds. Reload the page to try again." });
    return;
  }
  setTimeout(connect, wait);
  report();
}

/** Reports the time that remains to reconnect. */
function report(): void {
  if (hello === null || isOver || isWelcome) return;
  scope.postMessage({ kind: "retrying", was_joined: retry.wasJoined, seconds_left: retry.secondsLeft(now()), sentence: refusal });
}

function ping(): void {
  send({ type: "ping", id: ++pings, sent_ms: now() });
}

function takeText(frame: string): void {
  const message = decodeText(frame);
  if (message === null) return;
  if (message.type === "pong") {
    clock.add(message.sent_ms, now(), message.server_us);
    scope.postMessage({ kind: "clock", offset_us: clock.offset_us(), rtt_ms: clock.rtt_ms() });
    return;
  }
  if (message.type === "welcome") {
    isWelcome = true;
    retry = new Retry(true);
    seat = message.seat;
  } else if (message.type === "refused") {
    refused(message.sentence, message.is_temporary);
    return;
  } else if (message.type === "goodbye") {
    end({ kind: "ended", sentence: message.sentence });
    return;
  }
  scope.postMessage({ kind: "text", message });
}

function refused(sentence: string, isTemporary: boolean): void {
  if (seat !== null && !isTemporary) {
    // The seat may be too old, while a new one is free.
    seat = null;
    refusal = sentence;
    hangUp();
    lose(null, "");
  } else if (isTemporary) {
    refusal = sentence;
    report();
    hangUp();
    lose(null, "");
  } else {
    end({ kind: "refused", sentence });
  }
}

function takeBinary(frame: ArrayBuffer, isOrdered: boolean): void {
  const message = decodeBinary(frame);
  if (message === null) return;
  if (message.kind === "surface") {
    hasSurface = true;
    const { version, numbers, rest, triangles } = message;
    scope.postMessage({ kind: "binary", message, arrived_ms: heard_ms }, [numbers.buffer, rest.buffer, triangles.buffer]);
    order.addSurface(version);
  } else if (message.kind === "springs") {
    scope.postMessage({ kind: "binary", message, arrived_ms: heard_ms }, [message.ends.buffer]);
  } else if (message.kind === "shape") {
    if (isOrdered) postShape(message);
    else order.add(message);
  } else if (isOrdered || message.sent_us > toolsSent_us) {
    toolsSent_us = message.sent_us;
    scope.postMessage({ kind: "binary", message, arrived_ms: heard_ms });
  }
}

function postShape(message: Shape): void {
  const parts: Transferable[] = [message.displacements.buffer];
  if (message.nodes !== null) parts.push(message.nodes.buffer);
  scope.postMessage({ kind: "binary", message, arrived_ms: heard_ms }, parts);
}

scope.onmessage = (event) => {
  const command = event.data;
  if (command.kind === "open") {
    ({ hello, seat } = command);
    dialer = new Dialer(command.url, command.usesSocket);
    retry.begin(now());
    connect();
  } else if (command.kind === "text") {
    // A reconnect announces the tool that is held now.
    if (command.message.type === "tool" && hello !== null && "role" in hello) hello = { ...hello, tool: command.message.tool };
    send(command.message);
    if (command.message.type === "leave") end({ kind: "ended", sentence: "You left the session." });
  } else if (isWelcome) {
    link?.sendFrame(command.frame);
  }
};

setInterval(() => {
  if (link !== null) ping();
  if (call !== null && now() - heard_ms > (isWelcome && !hasSurface ? DOWNLOAD_MS : SILENCE_MS)) {
    hangUp();
    lose(null, "");
  }
  report();
}, PING_MS);
