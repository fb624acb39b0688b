import assert from "node:assert/strict";
import { test } from "node:test";
import { decodeBinary, encodeMotion } from "../src/frames.ts";
import { ProtocolError, type Shape, type Springs, type Surface, type Tools } from "../src/messages.ts";

function bytes(...parts: (ArrayBufferView | number[])[]): ArrayBuffer {
  const all = parts.map((p) => (Array.isArray(p) ? Uint8Array.from(p) : new Uint8Array(p.buffer, p.byteOffset, p.byteLength)));
  const joined = new Uint8Array(all.reduce((sum, p) => sum + p.length, 0));
  let at = 0;
  for (const part of all) {
    joined.set(part, at);
    at += part.length;
  }
  return joined.buffer;
}

function surface(triangles = [0, 1, 2, 0, 2, 1], count = 2): ArrayBuffer {
  const groups = [{ region: 1, other: 0, is_wound: false, start: 0, count }];
  const json = JSON.stringify({ version: 7, hash: "00ff", spacing_m: 0.002, nodes: 3, triangles: 2, groups });
  const header = new TextEncoder().encode(json.padEnd(Math.ceil(json.length / 4) * 4));
  const rest = Float32Array.from([0, 0, 0, 1, 0, 0, 0, 1, 0]);
  return bytes([1, 0, 0, 0], Uint32Array.from([header.length]), header, Uint32Array.from([4, 9, 11]), rest, Uint32Array.from(triangles));
}

function shape(isFull: boolean): ArrayBuffer {
  const count = isFull ? 3 : 1;
  const steps = new Int16Array(isFull ? 10 : 4);
  steps.set([1000, -2000, 32767]);
  const reaction = bytes(Uint16Array.from([5, 1]), Float32Array.from([0, 0, 2, 1, 1, 1, 3, 3, 3, 0, 0, 2]));
  return bytes(
    [2, Number(isFull), 1, 0],
    Uint32Array.from([7, 41, count]),
    Float32Array.from([1e-6]),
    Float64Array.from([2_000_000, 1.7e12]),
    Uint32Array.from(isFull ? [] : [2]),
    steps,
    new Uint8Array(reaction),
  );
}

function tools(rotation = [0, 0, 0, 1]): ArrayBuffer {
  const pose = bytes(Uint16Array.from([5]), [5, 1], Float32Array.from([1, 2, 3, ...rotation, 0, 0, -4]));
  return bytes([3, 0, 1, 0], Float32Array.from([60]), Float64Array.from([2_000_000, 2_060_000]), new Uint8Array(pose));
}

/** Springs 0-1, 0-3, 2-200 and 2-203 of region 5 of version 7. */
function springs(numbers = [0, 1, 0, 2, 2, 0xc6, 1, 0, 3], count = 4): ArrayBuffer {
  return bytes([4, 1, 5, 0], Uint32Array.from([7, count]), numbers);
}

test("a_surface_is_read_whole", () => {
  const read = decodeBinary(surface()) as Surface;
  assert.equal(read.version, 7);
  assert.deepEqual([...read.numbers], [4, 9, 11]);
  assert.deepEqual([...read.rest.slice(3, 6)], [1, 0, 0]);
  assert.deepEqual([...read.triangles], [0, 1, 2, 0, 2, 1]);
  assert.deepEqual(read.groups[0], { region: 1, other: 0, is_wound: false, start: 0, count: 2 });
});

test("a_surface_with_a_wrong_index_or_group_is_rejected", () => {
  assert.throws(() => decodeBinary(surface([0, 1, 3, 0, 2, 1])), ProtocolError);
  assert.throws(() => decodeBinary(surface(undefined, 3)), ProtocolError);
});

test("full_and_partial_shapes_are_read_with_reactions", () => {
  const full = decodeBinary(shape(true)) as Shape;
  assert.equal(full.nodes, null);
  assert.equal(full.displacements.length, 9);
  assert.ok(Math.abs(full.displacements[1] + 2e-3) < 1e-9);
  const partial = decodeBinary(shape(false)) as Shape;
  assert.deepEqual([...partial.nodes!], [2]);
  assert.equal(partial.number, 41);
  assert.equal(partial.time_us, 2_000_000);
  assert.deepEqual(partial.reactions, [
    { participant: 5, force: [0, 0, 2], position: [1, 1, 1], points: [{ position: [3, 3, 3], force: [0, 0, 2] }] },
  ]);
});

test("tools_are_read_with_flags_and_a_unit_rotation", () => {
  const read = decodeBinary(tools([0, 0, 0, 2])) as Tools;
  assert.equal(read.delay_ms, 60);
  const [pose] = read.tools;
  assert.deepEqual([pose.is_active, pose.is_device, pose.is_proxy, pose.buttons], [true, false, true, 1]);
  assert.deepEqual(pose.rotation, [0, 0, 0, 1]);
  assert.deepEqual(pose.force, [0, 0, -4]);
});

test("numbers_that_are_not_finite_are_rejected", () => {
  assert.throws(() => decodeBinary(tools([0, 0, 0, Number.NaN])), ProtocolError);
  assert.throws(() => decodeBinary(tools([0, 0, 0, 0])), ProtocolError);
});

test("springs_are_read_as_pairs_of_nodes", () => {
  const read = decodeBinary(springs()) as Springs;
  assert.deepEqual([read.kind, read.region, read.version, read.isCutShort], ["springs", 5, 7, true]);
  assert.deepEqual([...read.ends], [0, 1, 0, 3, 2, 200, 2, 203]);
});

test("springs_that_lead_nowhere_or_are_too_many_are_rejected", () => {
  assert.throws(() => decodeBinary(springs([0, 0], 1)), ProtocolError);
  assert.throws(() => decodeBinary(springs([0, 0xff, 0xff, 0xff, 0xff, 0xff, 1], 1)), ProtocolError);
  assert.throws(() => decodeBinary(springs(undefined, 0xffff_ffff)), ProtocolError);
});

test("every_truncated_frame_is_rejected", () => {
  for (const frame of [surface(), shape(true), shape(false), tools(), springs()]) {
    for (let length = 1; length < frame.byteLength; length++) {
      assert.throws(() => decodeBinary(frame.slice(0, length)), ProtocolError, `${length} of ${frame.byteLength} bytes`);
    }
  }
});

test("frames_with_bytes_too_many_are_rejected", () => {
  for (const frame of [surface(), shape(true), shape(false), tools(), springs()]) {
    assert.throws(() => decodeBinary(bytes(new Uint8Array(frame), [0, 0, 0, 0])), ProtocolError);
  }
});

test("unknown_kinds_are_ignored", () => {
  assert.equal(decodeBinary(new Uint8Array([99, 0, 0, 0, 0, 0, 0, 0]).buffer), null);
});

test("motion_is_written_as_specified", () => {
  const view = new DataView(encodeMotion([{ time_us: 12.5, position: [1, 2, 3], rotation: [0, 0, 0, 1], buttons: 1 }]));
  assert.equal(view.byteLength, 44);
  assert.deepEqual([view.getUint8(0), view.getUint8(1), view.getUint16(2, true)], [16, 1, 0]);
  assert.equal(view.getFloat64(4, true), 12.5);
  assert.deepEqual([12, 16, 20, 24, 28, 32, 36].map((at) => view.getFloat32(at, true)), [1, 2, 3, 0, 0, 0, 1]);
  assert.equal(view.getUint32(40, true), 1);
  assert.throws(() => encodeMotion([]), ProtocolError);
});
