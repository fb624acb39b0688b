// Form of a tool: its parts as the solver sees them. In its own frame the tip is at the origin and the handle lies along z;
// everything within the radius of a part belongs to the tool.
import type { Tool, ToolKind, Vector } from "./messages.ts";

/** Distance between the tips of open jaws, in parts of their length. */
const OPENING = 0.25;
export const RADIUS_MIN_MM = 0.2;
export const RADIUS_MAX_MM = 20;

/** Middle and half axes of a part, m: every `middle + s along + t across` with s and t from -1 to 1. */
export interface Part {
  middle: Vector;
  along: Vector;
  across: Vector;
}

/** Parts of a tool; `isHeld` is the state of its main button. */
export function parts(tool: Tool, isHeld: boolean): Part[] {
  const half = tool.length_mm / 2000;
  const across: Vector = [0, tool.width_mm / 2000, 0];
  const zero: Vector = [0, 0, 0];
  switch (tool.kind) {
    case "ball":
      return [{ middle: zero, along: zero, across: zero }];
    case "blade":
    case "needle":
      return [{ middle: [0, 0, half], along: [0, 0, half], across: zero }];
    case "plate":
      return [{ middle: zero, along: [half, 0, 0], across }];
    case "forceps": {
      // Closed jaws touch along their whole length; open ones meet at the joint.
      const tip = isHeld ? 0 : 0.5 * OPENING * 2 * half;
      return [1, -1].map((side) => ({
        middle: [side * (tool.radius_mm / 1000 + 0.5 * tip), 0, half],
        along: [-side * 0.5 * tip, 0, half],
        across,
      }));
    }
  }
}

/** Length of a tool along its handle, without the handle, m. */
export function extent_m(tool: Tool): number {
  return ((tool.kind === "plate" ? 0 : tool.length_mm) + tool.radius_mm) / 1000;
}

const USUAL: Record<ToolKind, Tool> = {
  ball: { kind: "ball", radius_mm: 5, length_mm: 0, width_mm: 0 },
  blade: { kind: "blade", radius_mm: 0.5, length_mm: 30, width_mm: 0 },
  needle: { kind: "needle", radius_mm: 0.6, length_mm: 50, width_mm: 0 },
  plate: { kind: "plate", radius_mm: 1, length_mm: 30, width_mm: 20 },
  forceps: { kind: "forceps", radius_mm: 1.5, length_mm: 30, width_mm: 5 },
};

/** The usual tool of a kind. */
export function usual(kind: ToolKind): Tool {
  return { ...USUAL[kind] };
}

/** The tool with a radius that is larger (1) or smaller (-1) by a step of about a fifth. */
export function resized(tool: Tool, direction: 1 | -1): Tool {
  const scaled = tool.radius_mm * (direction > 0 ? 1.2 : 1 / 1.2);
  const rounded = scaled < 2 ? Math.round(scaled * 20) / 20 : Math.round(scaled * 5) / 5;
  return { ...tool, radius_mm: Math.max(RADIUS_MIN_MM, Math.min(RADIUS_MAX_MM, rounded)) };
}
