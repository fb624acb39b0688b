// Frames on a stream of bytes: length (u32, little endian), type (u8), content.
import { check } from "./messages.ts";

const HEAD = 5;
export const TEXT = 0;
export const BINARY = 1;
/** A longer frame is an error of the host, bytes. */
const LENGTH_MAX = 256 * 1024 * 1024;

/** Joins the parts of a stream. */
export function join(parts: readonly Uint8Array[]): Uint8Array<ArrayBuffer> {
  const joined = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    joined.set(part, at);
    at += part.length;
  }
  return joined;
}

export function encodeFrame(type: number, content: Uint8Array): Uint8Array<ArrayBuffer> {
  const frame = new Uint8Array(HEAD + content.length);
  new DataView(frame.buffer).setUint32(0, content.length, true);
  frame[4] = type;
  frame.set(content, HEAD);
  return frame;
}

/** Splits a stream into frames, however its bytes arrive. */
export class FrameSplitter {
  private parts: Uint8Array[] = [];
  private length = 0;
  /** Bytes until the next step: a head, or a frame with its head. */
  private wanted = HEAD;

  constructor(private readonly take: (type: number, content: Uint8Array<ArrayBuffer>) => void) {}

  add(part: Uint8Array): void {
    this.parts.push(part);
    this.length += part.length;
    // A large frame is joined once, when it is complete.
    while (this.length >= this.wanted) {
      const all = join(this.parts);
      const length = new DataView(all.buffer).getUint32(0, true);
      check(length <= LENGTH_MAX, `invalid frame: ${length} bytes`);
      const isWhole = all.length >= HEAD + length;
      if (isWhole) this.take(all[4], all.slice(HEAD, HEAD + length));
      const rest = isWhole ? all.subarray(HEAD + length) : all;
      this.parts = [rest];
      this.length = rest.length;
      this.wanted = isWhole ? HEAD : HEAD + length;
    }
  }
}
