// The connection by WebTransport: texts and surfaces on one stream, tools and motion as datagrams, each shape on a stream of its
// own.
import type { Link, LinkEvents } from "./link.ts";
import { BINARY, FrameSplitter, TEXT, encodeFrame, join } from "./stream_frames.ts";

/** A session that takes longer to open counts as impossible, because many networks drop UDP, ms. */
const OPEN_MS = 2000;
/** Longest wait for the last frames before a close, ms. */
const FLUSH_MS = 500;

export interface Endpoint {
  url: string;
  hashes: Uint8Array<ArrayBuffer>[];
}

function timeout(ms: number): Promise<never> {
  return new Promise((_, reject) => setTimeout(() => reject(new Error(`no answer within ${ms} ms`)), ms));
}

export class SessionLink implements Link {
  readonly transport = "WebTransport";
  private readonly writer: WritableStreamDefaultWriter<Uint8Array>;
  private readonly datagrams: WritableStreamDefaultWriter<Uint8Array>;
  private events: LinkEvents | null = null;

  /** Opens a session; fails if the host does not accept it in time. */
  static async open({ url, hashes }: Endpoint): Promise<SessionLink> {
    const serverCertificateHashes = hashes.map((value) => ({ algorithm: "sha-256", value }));
    const session = new WebTransport(url, { serverCertificateHashes });
    // A failure is reported by `ready`.
    session.closed.catch(() => undefined);
    try {
      await Promise.race([session.ready, timeout(OPEN_MS)]);
      return new SessionLink(session, await session.createBidirectionalStream());
    } catch (error) {
      session.close();
      throw error;
    }
  }

  private constructor(
    private readonly session: WebTransport,
    private readonly stream: WebTransportBidirectionalStream,
  ) {
    this.writer = stream.writable.getWriter();
    this.datagrams = session.datagrams.writable.getWriter();
  }

  /** Takes messages from now on. */
  start(events: LinkEvents): void {
    this.events = events;
    void this.session.closed.then(
      ({ closeCode, reason }) => this.end(closeCode ?? null, reason ?? ""),
      () => this.end(null, ""),
    );
    void this.readStream();
    void this.readDatagrams();
    void this.readShapes();
    events.open(this);
  }

  private end(code: number | null, reason: string): void {
    const events = this.events;
    this.events = null;
    events?.close(code, reason);
  }

  private async readStream(): Promise<void> {
    const text = new TextDecoder();
    const splitter = new FrameSplitter((type, content) => {
      if (type === TEXT) this.events?.text(text.decode(content));
      else if (type === BINARY) this.events?.binary(content.buffer, true);
    });
    // A stream that is not in the format can not be continued.
    await each(this.stream.readable, (part) => splitter.add(part)).catch(() => this.session.close());
  }

  private async readDatagrams(): Promise<void> {
    await each(this.session.datagrams.readable as ReadableStream<Uint8Array>, (frame) => this.events?.binary(frame.slice().buffer, false));
  }

  private async readShapes(): Promise<void> {
    await each(this.session.incomingUnidirectionalStreams as ReadableStream<ReadableStream<Uint8Array>>, (stream) => void this.readShape(stream));
  }

  private async readShape(stream: ReadableStream<Uint8Array>): Promise<void> {
    const parts: Uint8Array[] = [];
    const isWhole = await each(stream, (part) => parts.push(part));
    if (isWhole) this.events?.binary(join(parts).buffer, false);
  }

  sendText(text: string): void {
    this.write(encodeFrame(TEXT, new TextEncoder().encode(text)));
  }

  sendFrame(frame: ArrayBuffer): void {
    const content = new Uint8Array(frame);
    if (content.length > this.session.datagrams.maxDatagramSize) this.write(encodeFrame(BINARY, content));
    else this.datagrams.write(content).catch(() => undefined);
  }

  private write(frame: Uint8Array): void {
    // The end of the session is an event of its own.
    this.writer.write(frame).catch(() => undefined);
  }

  close(): void {
    this.events = null;
    const flushed = Promise.race([this.writer.close(), timeout(FLUSH_MS)]);
    void flushed.catch(() => undefined).then(() => this.session.close());
  }
}

/** Takes what a stream brings; returns whether it came to its end, and not to a reset. */
async function each<T>(stream: ReadableStream<T>, take: (value: T) => void): Promise<boolean> {
  const reader = stream.getReader();
  for (;;) {
    const next = await reader.read().catch(() => null);
    if (next === null) return false;
    if (next.done) return true;
    take(next.value);
  }
}
