// The page's side of the worker: orders to it, and its messages as callbacks.
import { encodeMotion } from "./frames.ts";
import type { TransportName } from "./link.ts";
import type { HostBinary, HostText, PageText, Pong, Sample, Seat } from "./messages.ts";

export type ToWorker =
  | { kind: "open"; url: string; usesSocket: boolean; hello: Extract<PageText, { type: "hello" }>; seat: Seat | null }
  | { kind: "text"; message: PageText }
  | { kind: "motion"; frame: ArrayBuffer };

export type FromWorker =
  | { kind: "text"; message: Exclude<HostText, Pong> }
  | { kind: "binary"; message: HostBinary; /** Time since 1970. */ arrived_ms: number }
  | { kind: "transport"; name: TransportName }
  | { kind: "clock"; offset_us: number | null; rtt_ms: number | null }
  | { kind: "retrying"; was_joined: boolean; seconds_left: number; sentence: string | null }
  | { kind: "refused"; sentence: string }
  | { kind: "ended"; sentence: string };

export class Connection {
  private readonly worker = new Worker(new URL("./worker.ts", import.meta.url), { type: "module" });
  private offset_us: number | null = null;
  /** The last round trip of the page, ms. */
  rtt_ms: number | null = null;
  /** The transport of the present or last connection. */
  transport: TransportName | null = null;

  constructor(take: (message: FromWorker) => void) {
    this.worker.onmessage = (event: MessageEvent<FromWorker>) => {
      if (event.data.kind === "clock") {
        this.offset_us = event.data.offset_us;
        this.rtt_ms = event.data.rtt_ms;
      } else if (event.data.kind === "transport") {
        this.transport = event.data.name;
      } else {
        take(event.data);
      }
    };
  }

  private post(order: ToWorker, transfer: Transferable[] = []): void {
    this.worker.postMessage(order, transfer);
  }

  open(hello: Extract<PageText, { type: "hello" }>, seat: Seat | null): void {
    const url = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/session`;
    const usesSocket = new URLSearchParams(location.search).get("transport") === "websocket";
    this.post({ kind: "open", url, usesSocket, hello, seat });
  }

  send(message: PageText): void {
    this.post({ kind: "text", message });
  }

  move(samples: readonly Sample[]): void {
    const frame = encodeMotion(samples);
    this.post({ kind: "motion", frame }, [frame]);
  }

  /** Time of the server's clock, µs; null while unknown. */
  serverTime_us(): number | null {
    return this.offset_us === null ? null : 1000 * (performance.timeOrigin + performance.now()) + this.offset_us;
  }
}
