// The proxy of a device: the outline of the tool where the tissue would no longer press it, and a line to it from the device.
// Its stripes of black and white differ from solid tools by form and show on any ground, light or dark.
import * as THREE from "three";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";
import { parts } from "./form.ts";
import type { Tool } from "./messages.ts";

const DARK = [0.01, 0.01, 0.015];
const LIGHT = [1, 1, 1];
/** Width of the lines, in pixels. */
const WIDTH_PX = 2.5;
/** Length of a stripe of an edge, and the most stripes of one. */
const STRIPE_M = 0.004;
const STRIPES_MAX = 16;
/** Stripes of a circle, few enough for a small picture, and segments of a stripe that keep it round. */
const CIRCLE_STRIPES = 8;
const ARCS = 4;
/** Stripes of the line from the device. */
const LEADER_STRIPES = 6;

/** Segments of striped lines, six coordinates each. */
class Stripes {
  private readonly ends: number[] = [];
  private readonly colours: number[] = [];

  /** Adds a curve, given by its points for parameters from 0 to 1; `arcs` is the number of straight segments of a stripe. */
  add(curve: (share: number) => THREE.Vector3, stripes: number, arcs = 1): void {
    const count = stripes * arcs;
    for (let i = 0; i < count; i++) {
      this.ends.push(...curve(i / count).toArray(), ...curve((i + 1) / count).toArray());
      const colour = Math.floor(i / arcs) % 2 === 0 ? DARK : LIGHT;
      this.colours.push(...colour, ...colour);
    }
  }

  lines(): LineSegments2 {
    const geometry = new LineSegmentsGeometry().setPositions(this.ends).setColors(this.colours);
    // The proxy lies in the surface of the tissue, so a depth test would hide parts of it.
    const material = new LineMaterial({ linewidth: WIDTH_PX, vertexColors: true, depthTest: false, transparent: true });
    const lines = new LineSegments2(geometry, material);
    lines.frustumCulled = false;
    lines.renderOrder = 12;
    return lines;
  }
}

/** The outline of the parts of a tool that touch, in the frame of the tool. */
export function outline(tool: Tool, isHeld: boolean): LineSegments2 {
  const stripes = new Stripes();
  const radius = tool.radius_mm / 1000;
  const axes = [new THREE.Vector3(1, 0, 0), new THREE.Vector3(0, 1, 0), new THREE.Vector3(0, 0, 1)];
  for (const part of parts(tool, isHeld)) {
    const middle = new THREE.Vector3(...part.middle);
    if (tool.kind === "ball") {
      for (const [i, u] of axes.entries()) {
        const v = axes[(i + 1) % 3];
        const point = (share: number): THREE.Vector3 => {
          const angle = 2 * Math.PI * share;
          return middle.clone().addScaledVector(u, radius * Math.cos(angle)).addScaledVector(v, radius * Math.sin(angle));
        };
        stripes.add(point, CIRCLE_STRIPES, ARCS);
      }
      continue;
    }
    for (const [from, to] of edges(part.along, part.across, radius)) {
      const count = Math.min(STRIPES_MAX, Math.max(2, 2 * Math.round(from.distanceTo(to) / STRIPE_M / 2)));
      stripes.add((share) => from.clone().lerp(to, share).add(middle), count);
    }
  }
  return stripes.lines();
}

/** The edges of the box around a part whose half axes are `along` and `across`. */
function edges(along: readonly number[], across: readonly number[], radius: number): [THREE.Vector3, THREE.Vector3][] {
  const a = new THREE.Vector3(...along);
  const b = new THREE.Vector3(...across);
  const first = a.clone().normalize();
  const second = b.lengthSq() > 0 ? b.clone().normalize() : new THREE.Vector3(0, 1, 0);
  const halves = [a.addScaledVector(first, radius), b.addScaledVector(second, radius), first.clone().cross(second).multiplyScalar(radius)];
  const corner = (signs: number): THREE.Vector3 =>
    halves.reduce((sum, half, i) => sum.addScaledVector(half, (signs >> i) & 1 ? 1 : -1), new THREE.Vector3());
  const found: [THREE.Vector3, THREE.Vector3][] = [];
  for (let signs = 0; signs < 8; signs++) {
    for (let i = 0; i < 3; i++) if (((signs >> i) & 1) === 0) found.push([corner(signs), corner(signs | (1 << i))]);
  }
  return found;
}

/** A line of unit length along z. */
export function leader(): LineSegments2 {
  const stripes = new Stripes();
  stripes.add((share) => new THREE.Vector3(0, 0, share), LEADER_STRIPES);
  return stripes.lines();
}

/** Stretches a leader from one point to another. */
export function lead(line: THREE.Object3D, from: THREE.Vector3, to: THREE.Vector3): void {
  const span = to.clone().sub(from);
  const length = span.length();
  line.visible = length > 1e-6;
  if (!line.visible) return;
  line.position.copy(from);
  line.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), span.divideScalar(length));
  line.scale.set(1, 1, length);
}
