import assert from "node:assert/strict";
import { test } from "node:test";
import { ProtocolError } from "../src/messages.ts";
import { BINARY, FrameSplitter, TEXT, encodeFrame, join } from "../src/stream_frames.ts";

test("frames_are_equal_however_the_stream_is_split", () => {
  const contents = [Uint8Array.from([1, 2, 3]), new Uint8Array(0), new Uint8Array(300).fill(7)];
  const stream = join(contents.map((content, k) => encodeFrame(k === 0 ? TEXT : BINARY, content)));
  for (let size = 1; size <= stream.length; size++) {
    const found: [number, number[]][] = [];
    const splitter = new FrameSplitter((type, content) => found.push([type, [...content]]));
    for (let at = 0; at < stream.length; at += size) splitter.add(stream.subarray(at, at + size));
    assert.deepEqual(found, contents.map((content, k) => [k === 0 ? TEXT : BINARY, [...content]]), `parts of ${size} bytes`);
  }
});

test("a_frame_has_length_and_type_before_its_content", () => {
  assert.deepEqual([...encodeFrame(BINARY, Uint8Array.from([9, 8]))], [2, 0, 0, 0, 1, 9, 8]);
});

test("a_frame_of_absurd_length_is_rejected_before_it_arrives", () => {
  const splitter = new FrameSplitter(() => undefined);
  assert.throws(() => splitter.add(Uint8Array.from([0, 0, 0, 0xff, 1])), ProtocolError);
});
