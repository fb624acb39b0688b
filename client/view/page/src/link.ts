// A connection of the page to its host: a WebSocket or a WebTransport session, with the same messages.

export type TransportName = "WebSocket" | "WebTransport";

/** Messages of the host, in their order except where the format allows another one. */
export interface LinkEvents {
  open(link: Link): void;
  text(frame: string): void;
  /** `isOrdered`: no frame of its kind that was sent before can follow. */
  binary(frame: ArrayBuffer, isOrdered: boolean): void;
  /** The connection is gone, or there was none. `code` is null unless the host closed it. */
  close(code: number | null, reason: string): void;
}

export interface Link {
  readonly transport: TransportName;
  sendText(text: string): void;
  /** Sends a frame that the next one replaces. */
  sendFrame(frame: ArrayBuffer): void;
  /** Closes after what was sent; no event follows. */
  close(): void;
}
