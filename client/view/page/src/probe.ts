// The page's state as an object for tests and for curious users: `window.palpate`.
import type { Act, ToolPose, Vector } from "./messages.ts";
import type { View } from "./view.ts";

interface Palpate {
  /** The state of the page as plain values. */
  state(): unknown;
  /** Selects the node of the model whose displacement `state` reports; before that, it is the node displaced most. */
  probe(node: number): void;
  /** Steers the own tool towards a point (m), as a drag would, with its button held or not. */
  moveTool(position_m: Vector, isHeld: boolean): void;
  /** Sends an act of the instructor. */
  control(act: Act): void;
}

declare global {
  interface Window {
    palpate: Palpate;
  }
}

/** The link in one word. */
function connection(view: View): string {
  switch (view.status.phase.kind) {
    case "joined":
    case "downloading":
      return "open";
    case "asking":
    case "unsupported":
      return "none";
    default:
      return view.status.phase.kind;
  }
}

function displacement(view: View, node: number): Vector | null {
  const index = view.tissue.indexOf(node);
  return index === null ? null : (Array.from(view.playout.shown.subarray(3 * index, 3 * index + 3)) as Vector);
}

/** A pose of the own tool. */
interface OwnPose {
  position_m: Vector;
  /** Distance from the displayed outer surface, m; negative inside. */
  distance_m: number | null;
  force_n: number;
}

function own(view: View, is: (pose: ToolPose) => boolean): OwnPose | null {
  const pose = view.poses.find(is);
  return pose === undefined ? null : { position_m: pose.position, distance_m: view.tissue.distance(pose.position), force_n: Math.hypot(...pose.force) };
}

/** The node of the model that is displaced most; null without a surface. */
function displacedMost(view: View): number | null {
  const shown = view.playout.shown;
  let most = 0;
  for (let i = 0; i < shown.length / 3; i++) {
    const length = (k: number): number => Math.hypot(shown[3 * k], shown[3 * k + 1], shown[3 * k + 2]);
    if (length(i) > length(most)) most = i;
  }
  return view.tissue.surface?.numbers[most] ?? null;
}

export function publish(view: View): void {
  let selected: number | null = null;
  window.palpate = {
    state() {
      const { tissue, state, welcome, meter } = view;
      const kind = (participant: number): string | null => state?.participants.find((p) => p.id === participant)?.tool?.kind ?? null;
      const probed = selected ?? displacedMost(view);
      const shared = view.poses.filter((pose) => pose.is_active && !pose.is_device && !pose.is_proxy);
      return {
        connection: connection(view),
        role: welcome?.role ?? null,
        participant: welcome?.participant ?? null,
        participants: state?.participants ?? [],
        tools: shared.map((pose) => ({ participant: pose.participant, position_m: pose.position, kind: kind(pose.participant) })),
        topology_version: tissue.surface?.version ?? null,
        topology_hash: tissue.surface?.hash ?? null,
        nodes: (tissue.surface?.rest.length ?? 0) / 3,
        triangles: (tissue.surface?.triangles.length ?? 0) / 3,
        probe: probed === null ? null : { node: probed, displacement_m: displacement(view, probed) },
        fps: meter.fps,
        delay_ms: view.playout.delay_ms,
        latency_ms: meter.latency_ms,
        first_picture_ms: meter.first_picture_ms,
        annotations: (state?.annotations ?? []).map((annotation) => annotation.text),
        transport: view.connection.transport,
        status: view.status.word,
        notices: [...view.status.notices],
        is_frozen: state?.session.is_frozen ?? null,
        invitations: state?.invitations ?? [],
        device: own(view, (pose) => pose.is_device),
        proxy: own(view, (pose) => pose.is_proxy),
        springs: view.springs.figures(),
        own_force_n: view.force(welcome?.participant ?? null),
      };
    },
    probe(node) {
      selected = node;
    },
    moveTool([x, y, z], isHeld) {
      view.pointer.steer(x, y, z);
      view.pointer.holdButton(isHeld);
    },
    control(act) {
      view.control(act);
    },
  };
}
