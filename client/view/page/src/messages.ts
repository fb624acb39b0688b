// Types of the messages between the page and its host, version 1. Lengths in m, forces in N, times in
// µs of the server's clock, unless a name has another unit.

export const VERSION = 1;
export const SUBPROTOCOL = "palpate-view.1";

/** A message that violates the format. */
export class ProtocolError extends Error {}

export type Vector = [number, number, number];
export type Quaternion = [number, number, number, number];
export type ToolKind = "ball" | "blade" | "needle" | "plate" | "forceps";
export const TOOL_KINDS: readonly ToolKind[] = ["ball", "blade", "needle", "plate", "forceps"];

export interface Tool {
  kind: ToolKind;
  radius_mm: number;
  length_mm: number;
  width_mm: number;
}

export interface Seat {
  participant: number;
  token: string;
}

export interface Region {
  name: string;
  material: string;
  is_pinned: boolean;
}

export interface Welcome {
  type: "welcome";
  participant: number;
  name: string;
  role: string;
  source: "server" | "replica";
  can_steer: boolean;
  tick_hz: number;
  regions: Region[];
  seat: Seat | null;
}

/** Cores used per class of threads. */
export type Cores = Record<string, number>;

export interface Session {
  clock_s: number | null;
  is_frozen: boolean;
  is_locked: boolean;
  seats: number | null;
  spectators: number | null;
  delay_ms: number | null;
  delay_mode: string | null;
  delay_cap_ms: number | null;
  topology_version: number;
  topology_hash: string;
  operations: number | null;
  cuts: number | null;
  can_undo: boolean;
  can_redo: boolean;
  cpu: Cores;
}

export interface Participant {
  id: number;
  name: string;
  role: string;
  tool: Tool | null;
  is_connected: boolean;
  is_demoted: boolean;
  is_muted: boolean;
  force_limit_n: number | null;
  rtt_ms: number | null;
  loss: number | null;
  wanted_ms: number | null;
  is_page: boolean;
  emulation: Emulation | null;
}

/** A network that the instructor emulates. */
export interface Emulation {
  /** One-way delay. */
  delay_ms: number;
  loss_percent: number;
}

/** Figures of a local client. */
export interface Own {
  device: string | null;
  loop_hz: number | null;
  late_us_p99: number | null;
  model_age_ms: number | null;
  force_n: number | null;
  cpu: Cores;
  rtt_ms: number | null;
  loss: number | null;
}

export interface Annotation {
  id: number;
  text: string;
  kind: "pin" | "arrow";
  nodes: Vector;
  weights: Vector;
  offset_m: Vector;
}

export interface ShownCamera {
  id: number;
  position_m: Vector;
  target_m: Vector;
  up: Vector;
}

export interface State {
  type: "state";
  session: Session;
  participants: Participant[];
  own: Own | null;
  annotations: Annotation[];
  camera: ShownCamera | null;
  invitations: OpenInvitation[];
}

export interface OpenInvitation {
  id: number;
  role: string;
  /** The only name that may use it. */
  name: string | null;
  expires_us: number;
  is_single_use: boolean;
}

/** The addresses of a new invitation, for its creator. */
export interface InvitationAddresses {
  id: number;
  link: string;
  /** Null if the host has no page for it. */
  url: string | null;
}

export interface Pong {
  type: "pong";
  id: number;
  sent_ms: number;
  server_us: number;
}

export type HostText =
  | Welcome
  | State
  | Pong
  | { type: "refused"; sentence: string; is_temporary: boolean }
  | { type: "notice"; sentence: string }
  | ({ type: "invitation" } & InvitationAddresses)
  | { type: "goodbye"; sentence: string };

export type Act =
  | { act: "mute"; participant: number; is_muted: boolean }
  | { act: "hand_over" | "kick" | "ban"; participant: number }
  | { act: "freeze"; is_frozen: boolean }
  | { act: "reset" | "undo" | "redo" }
  | { act: "force_limit"; participant: number; newtons: number | null }
  | ({ act: "emulate"; participant: number } & Emulation)
  | { act: "lock"; is_locked: boolean }
  | { act: "capacity"; seats: number; spectators: number }
  | { act: "compensation"; mode: "none" | "fixed" | "adaptive"; ms: number }
  | { act: "annotate"; text: string; kind: "pin" | "arrow"; nodes: Vector; weights: Vector; offset_m: Vector }
  | { act: "remove_annotation" | "revoke_invitation"; id: number }
  | { act: "invite"; role: string; name: string | null; lifetime_s: number; is_single_use: boolean }
  | { act: "show_camera"; position_m: Vector; target_m: Vector; up: Vector };

export type PageText =
  | { type: "hello"; version: number; name: string; role: string; grant: string; tool: Tool | null; seat: Seat | null }
  | { type: "hello"; version: number; grant: string }
  | { type: "ping"; id: number; sent_ms: number }
  | { type: "tool"; tool: Tool }
  | ({ type: "control" } & Act)
  | { type: "springs"; /** Null ends them. */ region: number | null }
  | { type: "leave" };

export interface Group {
  region: number;
  other: number | null;
  is_wound: boolean;
  start: number;
  count: number;
}

/** The surface of one version of the topology. */
export interface Surface {
  kind: "surface";
  version: number;
  hash: string;
  spacing_m: number;
  groups: Group[];
  /** Numbers of the nodes in the model, ascending. */
  numbers: Uint32Array<ArrayBuffer>;
  /** Rest positions, m. */
  rest: Float32Array<ArrayBuffer>;
  /** Three node indices per triangle. */
  triangles: Uint32Array<ArrayBuffer>;
}

/** The reaction of the tissue on the tool of a participant. */
export interface Reaction {
  participant: number;
  force: Vector;
  position: Vector;
  points: { position: Vector; force: Vector }[];
}

/** Displacements from rest; of all nodes if `nodes` is null. */
export interface Shape {
  kind: "shape";
  version: number;
  number: number;
  /** Shared time, µs. */
  time_us: number;
  /** Wall time of the solve, ms since 1970. */
  solved_ms: number;
  nodes: Uint32Array<ArrayBuffer> | null;
  /** Three components per node, m. */
  displacements: Float32Array<ArrayBuffer>;
  reactions: Reaction[];
}

export interface ToolPose {
  participant: number;
  is_active: boolean;
  is_device: boolean;
  is_proxy: boolean;
  buttons: number;
  position: Vector;
  rotation: Quaternion;
  force: Vector;
}

export interface Tools {
  kind: "tools";
  delay_ms: number;
  time_us: number;
  sent_us: number;
  tools: ToolPose[];
}

/** Springs of a region with both ends on the surface of one version of the topology. */
export interface Springs {
  kind: "springs";
  version: number;
  region: number;
  /** Whether the host left springs out. */
  isCutShort: boolean;
  /** Two node indices of the surface per spring, the smaller first. */
  ends: Uint32Array<ArrayBuffer>;
}

export type HostBinary = Surface | Shape | Tools | Springs;

export interface Sample {
  time_us: number;
  position: Vector;
  rotation: Quaternion;
  buttons: number;
}

/** Throws a protocol error with the sentence unless the condition holds. */
export function check(condition: boolean, sentence: string): asserts condition {
  if (!condition) throw new ProtocolError(sentence);
}
