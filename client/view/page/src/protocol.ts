// Decodes the text frames of the host and checks every key that the page reads; encodes those of the page.
import {
  type Annotation,
  type Cores,
  type Emulation,
  type HostText,
  type OpenInvitation,
  type Own,
  type PageText,
  type Participant,
  ProtocolError,
  type Seat,
  type ShownCamera,
  type State,
  TOOL_KINDS,
  type Tool,
  type ToolKind,
  type Vector,
  type Welcome,
  check,
} from "./messages.ts";

type Fields = Record<string, unknown>;

function fields(value: unknown, of: string): Fields {
  check(typeof value === "object" && value !== null && !Array.isArray(value), `invalid message: ${of} is not an object`);
  return value as Fields;
}

function list(value: unknown, of: string): unknown[] {
  check(Array.isArray(value), `invalid message: ${of} is not a list`);
  return value;
}

function text(from: Fields, key: string): string {
  const value = from[key];
  check(typeof value === "string", `invalid message: ${key} is not a text`);
  return value;
}

function textOrNull(from: Fields, key: string): string | null {
  return from[key] === null || from[key] === undefined ? null : text(from, key);
}

function number(from: Fields, key: string): number {
  const value = from[key];
  check(typeof value === "number" && Number.isFinite(value), `invalid message: ${key} is not a number`);
  return value;
}

function numberOrNull(from: Fields, key: string): number | null {
  return from[key] === null || from[key] === undefined ? null : number(from, key);
}

function whole(from: Fields, key: string): number {
  const value = number(from, key);
  check(Number.isInteger(value) && value >= 0, `invalid message: ${key} is ${value}, not a whole number`);
  return value;
}

function flag(from: Fields, key: string): boolean {
  const value = from[key];
  check(typeof value === "boolean", `invalid message: ${key} is not true or false`);
  return value;
}

function vector(from: Fields, key: string): Vector {
  const value = list(from[key], key);
  check(value.length === 3 && value.every((x) => Number.isFinite(x)), `invalid message: ${key} is not three numbers`);
  return value as Vector;
}

function cores(from: Fields): Cores {
  const cpu = from.cpu;
  if (cpu === null || cpu === undefined) return {};
  return Object.fromEntries(Object.entries(fields(cpu, "cpu")).filter((e): e is [string, number] => typeof e[1] === "number"));
}

export function tool(value: unknown): Tool {
  const from = fields(value, "tool");
  const kind = text(from, "kind");
  check((TOOL_KINDS as readonly string[]).includes(kind), `invalid message: unknown tool ${kind}`);
  // A host computes in m, which leaves a rounding error in mm.
  const size = (key: string): number => Number(number(from, key).toFixed(4));
  return { kind: kind as ToolKind, radius_mm: size("radius_mm"), length_mm: size("length_mm"), width_mm: size("width_mm") };
}

function seat(value: unknown): Seat | null {
  if (value === null || value === undefined) return null;
  const from = fields(value, "seat");
  return { participant: whole(from, "participant"), token: text(from, "token") };
}

function welcome(from: Fields): Welcome {
  const source = text(from, "source");
  check(source === "server" || source === "replica", `invalid message: unknown source ${source}`);
  const regions = list(from.regions, "regions").map((value) => {
    const region = fields(value, "region");
    return { name: text(region, "name"), material: text(region, "material"), is_pinned: flag(region, "is_pinned") };
  });
  return {
    type: "welcome",
    participant: whole(from, "participant"),
    name: text(from, "name"),
    role: text(from, "role"),
    source,
    can_steer: flag(from, "can_steer"),
    tick_hz: number(from, "tick_hz"),
    regions,
    seat: seat(from.seat),
  };
}

function emulation(value: unknown): Emulation | null {
  if (value === null || value === undefined) return null;
  const from = fields(value, "emulation");
  return { delay_ms: number(from, "delay_ms"), loss_percent: number(from, "loss_percent") };
}

function state(from: Fields): State {
  const s = fields(from.session, "session");
  const participants = list(from.participants, "participants").map((value): Participant => {
    const p = fields(value, "participant");
    return {
      id: whole(p, "id"),
      name: text(p, "name"),
      role: text(p, "role"),
      tool: p.tool === null || p.tool === undefined ? null : tool(p.tool),
      is_connected: flag(p, "is_connected"),
      is_demoted: flag(p, "is_demoted"),
      is_muted: flag(p, "is_muted"),
      force_limit_n: numberOrNull(p, "force_limit_n"),
      rtt_ms: numberOrNull(p, "rtt_ms"),
      loss: numberOrNull(p, "loss"),
      wanted_ms: numberOrNull(p, "wanted_ms"),
      is_page: flag(p, "is_page"),
      emulation: emulation(p.emulation),
    };
  });
  const annotations = list(from.annotations, "annotations").map((value): Annotation => {
    const a = fields(value, "annotation");
    const kind = text(a, "kind");
    check(kind === "pin" || kind === "arrow", `invalid message: unknown annotation ${kind}`);
    return {
      id: whole(a, "id"),
      text: text(a, "text"),
      kind,
      nodes: vector(a, "nodes"),
      weights: vector(a, "weights"),
      offset_m: vector(a, "offset_m"),
    };
  });
  const invitations = list(from.invitations, "invitations").map((value): OpenInvitation => {
    const i = fields(value, "invitation");
    return {
      id: whole(i, "id"),
      role: text(i, "role"),
      name: textOrNull(i, "name"),
      expires_us: number(i, "expires_us"),
      is_single_use: flag(i, "is_single_use"),
    };
  });
  let own: Own | null = null;
  if (from.own !== null && from.own !== undefined) {
    const o = fields(from.own, "own");
    own = {
      device: textOrNull(o, "device"),
      loop_hz: numberOrNull(o, "loop_hz"),
      late_us_p99: numberOrNull(o, "late_us_p99"),
      model_age_ms: numberOrNull(o, "model_age_ms"),
      force_n: numberOrNull(o, "force_n"),
      cpu: cores(o),
      rtt_ms: numberOrNull(o, "rtt_ms"),
      loss: numberOrNull(o, "loss"),
    };
  }
  let camera: ShownCamera | null = null;
  if (from.camera !== null && from.camera !== undefined) {
    const c = fields(from.camera, "camera");
    camera = { id: whole(c, "id"), position_m: vector(c, "position_m"), target_m: vector(c, "target_m"), up: vector(c, "up") };
  }
  return {
    type: "state",
    session: {
      clock_s: numberOrNull(s, "clock_s"),
      is_frozen: flag(s, "is_frozen"),
      is_locked: flag(s, "is_locked"),
      seats: numberOrNull(s, "seats"),
      spectators: numberOrNull(s, "spectators"),
      delay_ms: numberOrNull(s, "delay_ms"),
      delay_mode: textOrNull(s, "delay_mode"),
      delay_cap_ms: numberOrNull(s, "delay_cap_ms"),
      topology_version: whole(s, "topology_version"),
      topology_hash: text(s, "topology_hash"),
      operations: numberOrNull(s, "operations"),
      cuts: numberOrNull(s, "cuts"),
      can_undo: flag(s, "can_undo"),
      can_redo: flag(s, "can_redo"),
      cpu: cores(s),
    },
    participants,
    own,
    annotations,
    camera,
    invitations,
  };
}

/** Decodes a text frame of the host; null for a type that this version does not know. */
export function decodeText(frame: string): HostText | null {
  let parsed: unknown;
  try {
    parsed = JSON.parse(frame);
  } catch {
    throw new ProtocolError("invalid message: a text frame is not JSON");
  }
  const from = fields(parsed, "a text frame");
  switch (text(from, "type")) {
    case "welcome":
      return welcome(from);
    case "state":
      return state(from);
    case "refused":
      return { type: "refused", sentence: text(from, "sentence"), is_temporary: from.is_temporary === true };
    case "notice":
      return { type: "notice", sentence: text(from, "sentence") };
    case "invitation":
      return { type: "invitation", id: whole(from, "id"), link: text(from, "link"), url: textOrNull(from, "url") };
    case "goodbye":
      return { type: "goodbye", sentence: text(from, "sentence") };
    case "pong":
      return { type: "pong", id: number(from, "id"), sent_ms: number(from, "sent_ms"), server_us: number(from, "server_us") };
    default:
      return null;
  }
}

/** Encodes a text frame of the page. */
export function encodeText(message: PageText): string {
  return JSON.stringify(message);
}
