// Playout buffer of shapes and tools by shared time. The displayed time runs evenly, one update period behind the newest update,
// so that there is nearly always an update on either side to interpolate between; it never runs back. The page of a local client
// waits an eighth of a period only, because its participant holds the device.
import type { Quaternion, Reaction, Shape, ToolPose, Tools, Vector } from "./messages.ts";

/** A displayed time that is later than this jumps ahead instead of running faster, s. */
const JUMP_S = 0.3;
/** Time in which a smaller error is taken up, s. */
const CATCH_UP_S = 0.2;
/** Largest change of the rate of the displayed time. */
const RATE = 0.25;
/** Period before it is measured, and its bound, s. */
const PERIOD_S = 1 / 30;
const PERIOD_MAX_S = 0.1;
const PERIODS_KEPT = 15;
/** Arrivals that count, about 1 s of them. */
const LEADS_KEPT = 32;
/** Shapes have paused when none has come for this time, ms. */
const PAUSE_MS = 300;
/** Updates that wait at most, about 4 s of them. */
const WAITING_MAX = 240;

/** Shapes or tools as they arrive. */
class Stream {
  private newest: { time_s: number; arrival_ms: number } | null = null;
  private readonly intervals: number[] = [];
  /** Shared time minus arrival of the recent updates, s. */
  private leads: number[] = [];

  add(time_s: number, arrival_ms: number): void {
    if (this.newest !== null && time_s <= this.newest.time_s) return;
    if (this.newest !== null) {
      this.intervals.push(time_s - this.newest.time_s);
      if (this.intervals.length > PERIODS_KEPT) this.intervals.shift();
    }
    this.newest = { time_s, arrival_ms };
    this.leads.push(time_s - arrival_ms / 1000);
    if (this.leads.length > LEADS_KEPT) this.leads.shift();
  }

  reset(): void {
    this.newest = null;
    this.leads = [];
  }

  /** Median interval between updates, s. */
  get period_s(): number {
    if (this.intervals.length === 0) return PERIOD_S;
    const sorted = [...this.intervals].sort((a, b) => a - b);
    return Math.min(sorted[sorted.length >> 1], PERIOD_MAX_S);
  }

  /**
   * The time that is `lag` periods behind the arrivals, and the newest time, s; null without updates. Three quarters of the
   * recent updates arrived in time for it; the few later ones do not delay the others.
   */
  target_s(now_ms: number, lag: number): [number, number] | null {
    if (this.newest === null) return null;
    const { time_s } = this.newest;
    const sorted = [...this.leads].sort((a, b) => a - b);
    return [Math.min(time_s, sorted[sorted.length >> 2] + now_ms / 1000 - lag * this.period_s), time_s];
  }

  isFlowing(now_ms: number): boolean {
    return this.newest !== null && now_ms - this.newest.arrival_ms < PAUSE_MS;
  }
}

/** Changes of the displayed shape in one step. */
export interface Step {
  /** The topology to display from now on, if it changed. */
  version: number | null;
  /** Whether any node may have moved. */
  isAll: boolean;
  /** Indices of the nodes that moved, if not all. */
  nodes: Uint32Array;
  /** Wall times of the solves that are displayed from now on, ms since 1970. */
  solved_ms: number[];
}

export class Playout {
  private readonly shapeStream = new Stream();
  private readonly toolStream = new Stream();
  private readonly nodeCounts = new Map<number, number>();
  private shapes: Shape[] = [];
  private frames: Tools[] = [];
  private displayed: { time_s: number; at_ms: number } | null = null;
  private nextNumber: number | null = null;
  private nextVersion: number | null = null;
  private version: number | null = null;
  private last_s = Number.NEGATIVE_INFINITY;
  /** Displacements at the last shape that is due. */
  private base = new Float32Array(0);
  /** Displayed displacements, three components per node. */
  shown = new Float32Array(0);
  private moved = new Uint32Array(0);
  private mark = new Uint8Array(0);
  /** Nodes between the last shape and the next. */
  private between: Uint32Array | "all" | null = null;
  /** Periods by which the displayed time is behind the newest update. */
  lag = 1;
  /** Reactions at the last shape that is due. */
  reactions: Reaction[] = [];

  /** Makes the topology of a surface known. The first one is displayed at once, at rest. */
  addSurface(version: number, nodes: number): number | null {
    this.nodeCounts.set(version, nodes);
    for (const old of this.nodeCounts.keys()) {
      if (this.nodeCounts.size > 4 && old !== this.version) this.nodeCounts.delete(old);
    }
    if (this.version !== null) return null;
    this.display(version);
    return version;
  }

  /** Whether a shape of this topology is displayed or waits. */
  hasShapeOf(version: number): boolean {
    return this.version === version || this.shapes.some((shape) => shape.version === version);
  }

  /** Displays a topology at rest. */
  display(version: number): void {
    const nodes = this.nodeCounts.get(version)!;
    this.version = version;
    this.base = new Float32Array(3 * nodes);
    this.shown = new Float32Array(3 * nodes);
    this.moved = new Uint32Array(nodes);
    this.mark = new Uint8Array(nodes);
    this.between = null;
  }

  /** Forgets waiting updates after a reconnect; the displayed shape stays until the next full one. */
  reset(): void {
    this.shapes = [];
    this.frames = [];
    this.shapeStream.reset();
    this.toolStream.reset();
    this.displayed = null;
    this.nextNumber = null;
    this.last_s = Number.NEGATIVE_INFINITY;
  }

  /** Whether the displayed shape lacks an update that was lost. */
  get isWaiting(): boolean {
    return this.nextNumber === null;
  }

  /** Takes a shape; returns whether it can be displayed. */
  addShape(shape: Shape, arrival_ms: number): boolean {
    const nodes = this.nodeCounts.get(shape.version);
    const follows = shape.nodes === null || (shape.number === this.nextNumber && shape.version === this.nextVersion);
    const fits =
      nodes !== undefined &&
      (shape.nodes === null ? shape.displacements.length === 3 * nodes : shape.nodes.every((node) => node < nodes));
    if (!follows || !fits) {
      this.nextNumber = null;
      return false;
    }
    this.nextNumber = shape.number + 1;
    this.nextVersion = shape.version;
    this.shapes.push(shape);
    if (this.shapes.length > WAITING_MAX) {
      // The next full shape replaces them.
      this.shapes = [];
      this.nextNumber = null;
    }
    this.shapeStream.add(shape.time_us / 1e6, arrival_ms);
    return true;
  }

  addTools(frame: Tools, arrival_ms: number): void {
    this.frames.push(frame);
    if (this.frames.length > WAITING_MAX) this.frames.shift();
    this.toolStream.add(frame.time_us / 1e6, arrival_ms);
  }

  /** The displayed shared time, s; null before the first update. */
  get time_s(): number | null {
    return this.displayed?.time_s ?? null;
  }

  private run(now_ms: number): number | null {
    // Shapes come after the tools of the same time, so they lead while they flow.
    const stream = this.shapeStream.isFlowing(now_ms) ? this.shapeStream : this.toolStream;
    const target = stream.target_s(now_ms, this.lag) ?? this.shapeStream.target_s(now_ms, this.lag);
    if (target === null) return null;
    const [target_s, newest_s] = target;
    if (this.displayed === null) {
      this.displayed = { time_s: target_s, at_ms: now_ms };
      return target_s;
    }
    const passed_s = Math.max(0, (now_ms - this.displayed.at_ms) / 1000);
    const late_s = target_s - this.displayed.time_s - passed_s;
    let time_s = target_s;
    if (late_s < JUMP_S) {
      const rate = 1 + Math.max(-RATE, Math.min(RATE, late_s / CATCH_UP_S));
      time_s = Math.min(newest_s, this.displayed.time_s + rate * passed_s);
    }
    this.displayed = { time_s: Math.max(time_s, this.displayed.time_s), at_ms: now_ms };
    return this.displayed.time_s;
  }

  /** Advances to a time of the page's clock, ms. */
  advance(now_ms: number): Step {
    const step: Step = { version: null, isAll: false, nodes: this.moved, solved_ms: [] };
    const time_s = this.run(now_ms);
    if (time_s === null) return { ...step, nodes: this.moved.subarray(0, 0) };
    let count = 0;
    const touch = (nodes: Uint32Array | null): void => {
      if (nodes === null) step.isAll = true;
      else for (const node of nodes) if (this.mark[node] === 0) ((this.mark[node] = 1), (this.moved[count++] = node));
    };
    if (this.between !== null) touch(this.between === "all" ? null : this.between);
    this.between = null;
    while (this.shapes.length > 0 && this.shapes[0].time_us / 1e6 <= time_s) {
      const shape = this.shapes.shift()!;
      if (shape.version !== this.version) {
        if (!this.nodeCounts.has(shape.version)) continue;
        this.display(shape.version);
        step.version = shape.version;
        step.isAll = true;
        count = 0;
      }
      this.settle(shape);
      touch(shape.nodes);
      step.solved_ms.push(shape.solved_ms);
      this.last_s = shape.time_us / 1e6;
      this.reactions = shape.reactions;
    }
    const next = this.shapes[0];
    const blends = next !== undefined && next.version === this.version;
    if (blends) touch(next.nodes);
    if (step.isAll) this.shown.set(this.base);
    else for (let i = 0; i < count; i++) this.shown.set(this.base.subarray(3 * this.moved[i], 3 * this.moved[i] + 3), 3 * this.moved[i]);
    if (blends) this.blend(next, time_s);
    for (let i = 0; i < count; i++) this.mark[this.moved[i]] = 0;
    step.nodes = this.moved.subarray(0, count);
    while (this.frames.length > 2 && this.frames[1].time_us / 1e6 <= time_s) this.frames.shift();
    return step;
  }

  private settle(shape: Shape): void {
    if (shape.nodes === null) {
      this.base.set(shape.displacements);
      return;
    }
    shape.nodes.forEach((node, i) => this.base.set(shape.displacements.subarray(3 * i, 3 * i + 3), 3 * node));
  }

  /** Interpolates towards the next shape. A shape after a pause starts one period before its time. */
  private blend(next: Shape, time_s: number): void {
    const end_s = next.time_us / 1e6;
    const start_s = Math.max(this.last_s, end_s - this.lag * this.shapeStream.period_s);
    const f = Math.max(0, Math.min(1, (time_s - start_s) / (end_s - start_s)));
    const { nodes, displacements } = next;
    const count = displacements.length / 3;
    for (let i = 0; i < count; i++) {
      const node = nodes === null ? i : nodes[i];
      for (let k = 0; k < 3; k++) {
        const from = this.base[3 * node + k];
        this.shown[3 * node + k] = from + f * (displacements[3 * i + k] - from);
      }
    }
    this.between = nodes ?? "all";
  }

  /** The tools at the displayed time; the pose and the proxy of the own device as new as they are known. */
  tools(): ToolPose[] {
    const newest = this.frames.at(-1);
    if (newest === undefined) return [];
    const time_s = this.displayed?.time_s ?? newest.time_us / 1e6;
    const next = this.frames.findIndex((frame) => frame.time_us / 1e6 > time_s);
    const after = next < 0 ? newest : this.frames[next];
    const before = next > 0 ? this.frames[next - 1] : after;
    const span_us = after.time_us - before.time_us;
    const f = span_us > 0 ? Math.max(0, Math.min(1, (1e6 * time_s - before.time_us) / span_us)) : 1;
    const isShared = (pose: ToolPose): boolean => !pose.is_device && !pose.is_proxy;
    const shared = after.tools.filter(isShared).map((pose) => {
      const from = before.tools.find((t) => isShared(t) && t.participant === pose.participant);
      return from === undefined ? pose : between(from, pose, f);
    });
    return [...shared, ...newest.tools.filter((pose) => !isShared(pose))];
  }

  /** Playout delay D of the newest update, ms. */
  get delay_ms(): number | null {
    return this.frames.at(-1)?.delay_ms ?? null;
  }
}

/** The pose at the fraction `f` of the way between two poses of one tool. */
export function between(from: ToolPose, to: ToolPose, f: number): ToolPose {
  const mix = (a: Vector, b: Vector): Vector => [0, 1, 2].map((i) => a[i] + f * (b[i] - a[i])) as Vector;
  const dot = from.rotation.reduce((sum, q, i) => sum + q * to.rotation[i], 0);
  const turn = from.rotation.map((q, i) => (dot < 0 ? -1 : 1) * (1 - f) * q + f * to.rotation[i]);
  const length = Math.hypot(...turn);
  return {
    ...to,
    position: mix(from.position, to.position),
    rotation: turn.map((q) => q / length) as Quaternion,
    force: mix(from.force, to.force),
  };
}

/** A pose with the force of the contacts, if the host sends no force with the pose. */
export function withReaction(pose: ToolPose, reactions: readonly Reaction[]): ToolPose {
  const reaction = pose.force.every((f) => f === 0) && !pose.is_device ? reactions.find((r) => r.participant === pose.participant) : undefined;
  return reaction === undefined ? pose : { ...pose, force: reaction.force };
}
