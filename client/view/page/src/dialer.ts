// Chooses the transport of each connection: WebTransport where browser, page and host have it, else a WebSocket.
import type { LinkEvents } from "./link.ts";
import { type Endpoint, SessionLink } from "./session_link.ts";
import { SocketLink } from "./socket_link.ts";

function bytes(hex: string): Uint8Array<ArrayBuffer> {
  return Uint8Array.from(hex.match(/../g) ?? [], (pair) => parseInt(pair, 16));
}

/** Reads the host's description of its endpoint; null if it is none. */
export function endpoint(description: unknown, hostname: string): Endpoint | null {
  if (typeof description !== "object" || description === null) return null;
  const { port, certificate_hashes } = description as Record<string, unknown>;
  const isPort = typeof port === "number" && Number.isInteger(port) && port > 0 && port < 65536;
  const isHash = (hash: unknown): hash is string => typeof hash === "string" && /^[0-9a-f]{64}$/.test(hash);
  if (!isPort || !Array.isArray(certificate_hashes) || !certificate_hashes.every(isHash)) return null;
  return { url: `https://${hostname}:${port}/session`, hashes: certificate_hashes.map(bytes) };
}

/** A connection, from the first attempt on. */
export interface Call {
  /** Ends it; no event follows. */
  close(): void;
}

export class Dialer {
  /** `usesSocket`: leave WebTransport out. */
  constructor(
    private readonly socketUrl: string,
    private usesSocket: boolean,
  ) {
    if (typeof WebTransport === "undefined" || !isSecureContext) this.usesSocket = true;
  }

  dial(events: LinkEvents): Call {
    if (this.usesSocket) return new SocketLink(this.socketUrl, events);
    let current: Call | null = null;
    let isOver = false;
    void this.session().then((link) => {
      if (isOver) link?.close();
      else if (link === null) current = new SocketLink(this.socketUrl, events);
      else {
        current = link;
        link.start(events);
      }
    });
    return {
      close: () => {
        isOver = true;
        current?.close();
      },
    };
  }

  /** A WebTransport session; null where only a WebSocket is possible. */
  private async session(): Promise<SessionLink | null> {
    const response = await fetch(new URL("/transport", location.href)).catch(() => null);
    // A host that does not answer may have WebTransport when it is back.
    if (response === null) return null;
    const description: unknown = response.ok ? await response.json().catch(() => null) : null;
    const found = endpoint(description, location.hostname);
    const link = found === null ? null : await SessionLink.open(found).catch(() => null);
    this.usesSocket = link === null;
    return link;
  }
}
