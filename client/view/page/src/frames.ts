// Decodes the binary frames of the host (surface, shape, tools, springs) and encodes the motion of the page's tool. Every length, index
// and number is checked, so that later code can trust them.
import {
  type Group,
  type HostBinary,
  type Reaction,
  type Sample,
  type Shape,
  type Springs,
  type Surface,
  type Tools,
  type Vector,
  check,
} from "./messages.ts";

const SURFACE = 1;
const SHAPE = 2;
const TOOLS = 3;
const SPRINGS = 4;
const MOTION = 16;
const SHAPE_HEADER = 36;
const TOOLS_HEADER = 24;
const SPRINGS_HEADER = 12;
/** A spring has at least two bytes. */
const SPRING_BYTES = 2;
const REACTION_BYTES = 28;
const POINT_BYTES = 24;
const TOOL_BYTES = 44;
const SAMPLE_BYTES = 40;
/** Most samples in a motion frame. */
export const SAMPLES_MAX = 32;

/** Decodes a binary frame; null for a kind that this version does not know. */
export function decodeBinary(frame: ArrayBuffer): HostBinary | null {
  check(frame.byteLength >= 8, `invalid frame: ${frame.byteLength} bytes`);
  const view = new DataView(frame);
  switch (view.getUint8(0)) {
    case SURFACE:
      return surface(view);
    case SHAPE:
      return shape(view);
    case TOOLS:
      return tools(view);
    case SPRINGS:
      return springs(view);
    default:
      return null;
  }
}

function whole(value: unknown, name: string): number {
  check(typeof value === "number" && Number.isInteger(value) && value >= 0, `invalid surface: ${name} is not a whole number`);
  return value;
}

function surface(view: DataView): Surface {
  const buffer = view.buffer as ArrayBuffer;
  const headerBytes = view.getUint32(4, true);
  check(headerBytes % 4 === 0 && 8 + headerBytes <= buffer.byteLength, `invalid surface: header of ${headerBytes} bytes`);
  let header: Record<string, unknown>;
  try {
    header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, headerBytes)));
  } catch {
    check(false, "invalid surface: the header is not JSON");
  }
  const nodes = whole(header.nodes, "nodes");
  const count = whole(header.triangles, "triangles");
  const expected = 8 + headerBytes + 16 * nodes + 12 * count;
  check(buffer.byteLength === expected, `invalid surface: ${buffer.byteLength} bytes, expected ${expected}`);
  let at = 8 + headerBytes;
  const numbers = new Uint32Array(buffer.slice(at, (at += 4 * nodes)));
  const rest = new Float32Array(buffer.slice(at, (at += 12 * nodes)));
  const triangles = new Uint32Array(buffer.slice(at));
  check(rest.every(Number.isFinite), "invalid surface: a rest position is not finite");
  check(triangles.every((i) => i < nodes), "invalid surface: a triangle names a node that does not exist");
  check(Array.isArray(header.groups), "invalid surface: groups is not a list");
  const groups = (header.groups as Record<string, unknown>[]).map((g): Group => {
    const start = whole(g.start, "start");
    const length = whole(g.count, "count");
    check(start + length <= count, `invalid surface: group ${start} + ${length} exceeds ${count} triangles`);
    return {
      region: whole(g.region, "region"),
      other: g.other === null || g.other === undefined ? null : whole(g.other, "other"),
      is_wound: g.is_wound === true,
      start,
      count: length,
    };
  });
  return {
    kind: "surface",
    version: whole(header.version, "version"),
    hash: String(header.hash),
    spacing_m: Number(header.spacing_m),
    groups,
    numbers,
    rest,
    triangles,
  };
}

function vector(view: DataView, at: number): Vector {
  const v: Vector = [view.getFloat32(at, true), view.getFloat32(at + 4, true), view.getFloat32(at + 8, true)];
  check(v.every(Number.isFinite), "invalid frame: a vector is not finite");
  return v;
}

function time(view: DataView, at: number): number {
  const value = view.getFloat64(at, true);
  check(Number.isFinite(value), "invalid frame: a time is not finite");
  return value;
}

function shape(view: DataView): Shape {
  const buffer = view.buffer as ArrayBuffer;
  check(buffer.byteLength >= SHAPE_HEADER, `invalid shape: ${buffer.byteLength} bytes`);
  const isFull = view.getUint8(1) === 1;
  const reactionCount = view.getUint16(2, true);
  const count = view.getUint32(12, true);
  const step = view.getFloat32(16, true);
  check(Number.isFinite(step), "invalid shape: the step is not finite");
  const indexBytes = isFull ? 0 : 4 * count;
  const valueBytes = Math.ceil((6 * count) / 4) * 4;
  let at = SHAPE_HEADER + indexBytes + valueBytes;
  check(at <= buffer.byteLength, `invalid shape: ${count} displacements in ${buffer.byteLength} bytes`);
  const nodes = isFull ? null : new Uint32Array(buffer.slice(SHAPE_HEADER, SHAPE_HEADER + indexBytes));
  const steps = new Int16Array(buffer, SHAPE_HEADER + indexBytes, 3 * count);
  const displacements = new Float32Array(3 * count);
  for (let i = 0; i < steps.length; i++) displacements[i] = step * steps[i];
  const reactions: Reaction[] = [];
  for (let r = 0; r < reactionCount; r++) {
    check(at + REACTION_BYTES <= buffer.byteLength, "invalid shape: a reaction is incomplete");
    const participant = view.getUint16(at, true);
    const points = view.getUint16(at + 2, true);
    const reaction: Reaction = { participant, force: vector(view, at + 4), position: vector(view, at + 16), points: [] };
    at += REACTION_BYTES;
    check(at + points * POINT_BYTES <= buffer.byteLength, "invalid shape: contact points are incomplete");
    for (let p = 0; p < points; p++, at += POINT_BYTES) {
      reaction.points.push({ position: vector(view, at), force: vector(view, at + 12) });
    }
    reactions.push(reaction);
  }
  check(at === buffer.byteLength, `invalid shape: ${buffer.byteLength - at} bytes too many`);
  return {
    kind: "shape",
    version: view.getUint32(4, true),
    number: view.getUint32(8, true),
    time_us: time(view, 20),
    solved_ms: time(view, 28),
    nodes,
    displacements,
    reactions,
  };
}

function tools(view: DataView): Tools {
  const count = view.getUint16(2, true);
  const expected = TOOLS_HEADER + TOOL_BYTES * count;
  check(view.byteLength === expected, `invalid tools: ${view.byteLength} bytes, expected ${expected}`);
  const found = [];
  for (let i = 0, at = TOOLS_HEADER; i < count; i++, at += TOOL_BYTES) {
    const flags = view.getUint8(at + 2);
    const turn = [16, 20, 24, 28].map((k) => view.getFloat32(at + k, true));
    const length = Math.hypot(...turn);
    check(Number.isFinite(length) && length > 1e-3, "invalid tools: a rotation is not a unit quaternion");
    const [x, y, z, w] = turn.map((q) => q / length);
    found.push({
      participant: view.getUint16(at, true),
      is_active: (flags & 1) !== 0,
      is_device: (flags & 2) !== 0,
      is_proxy: (flags & 4) !== 0,
      buttons: view.getUint8(at + 3),
      position: vector(view, at + 4),
      rotation: [x, y, z, w] as [number, number, number, number],
      force: vector(view, at + 32),
    });
  }
  return { kind: "tools", delay_ms: view.getFloat32(4, true), time_us: time(view, 8), sent_us: time(view, 16), tools: found };
}

function springs(view: DataView): Springs {
  check(view.byteLength >= SPRINGS_HEADER, `invalid springs: ${view.byteLength} bytes`);
  const count = view.getUint32(8, true);
  check(SPRINGS_HEADER + SPRING_BYTES * count <= view.byteLength, `invalid springs: ${count} springs in ${view.byteLength} bytes`);
  let at = SPRINGS_HEADER;
  const number = (): number => {
    let value = 0;
    for (let scale = 1; ; scale *= 128) {
      check(at < view.byteLength && scale < 2 ** 35, "invalid springs: a number is incomplete");
      const byte = view.getUint8(at++);
      value += scale * (byte & 127);
      if (byte < 128) return value;
    }
  };
  const ends = new Uint32Array(2 * count);
  let from = 0;
  let to = 0;
  for (let i = 0; i < count; i++) {
    const ahead = number();
    if (ahead > 0) to = from += ahead;
    to += number();
    check(from < to && to < 2 ** 32, "invalid springs: a spring does not lead ahead");
    ends[2 * i] = from;
    ends[2 * i + 1] = to;
  }
  check(at === view.byteLength, `invalid springs: ${view.byteLength - at} bytes too many`);
  return {
    kind: "springs",
    version: view.getUint32(4, true),
    region: view.getUint16(2, true),
    isCutShort: (view.getUint8(1) & 1) !== 0,
    ends,
  };
}

/** Encodes 1 to 32 samples of the page's tool. */
export function encodeMotion(samples: readonly Sample[]): ArrayBuffer {
  check(samples.length >= 1 && samples.length <= SAMPLES_MAX, `${samples.length} samples do not fit a motion frame`);
  const view = new DataView(new ArrayBuffer(4 + SAMPLE_BYTES * samples.length));
  view.setUint8(0, MOTION);
  view.setUint8(1, samples.length);
  samples.forEach((sample, i) => {
    const at = 4 + i * SAMPLE_BYTES;
    view.setFloat64(at, sample.time_us, true);
    [...sample.position, ...sample.rotation].forEach((x, k) => view.setFloat32(at + 8 + 4 * k, x, true));
    view.setUint32(at + 36, sample.buttons, true);
  });
  return view.buffer as ArrayBuffer;
}
