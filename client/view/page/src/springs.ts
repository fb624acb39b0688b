// Springs of a region, coloured by their strain: blue compressed, grey at rest, red stretched. The host names the springs of the
// surface once per topology; lengths follow from the displayed nodes.
import * as THREE from "three";
import { strainLight } from "./strain.ts";
import type { Springs } from "./messages.ts";
import type { Tissue } from "./tissue.ts";

/** Springs with a gap of at most so many are uploaded together. */
const GAP = 256;
/** More ranges than this are uploaded as one. */
const RANGES_MAX = 8;
/** Towards the eye, in parts of the depth range, so that springs are drawn over the faces that they lie in. */
const OVER = 4e-4;

/** Figures of the displayed springs. */
export interface SpringFigures {
  count: number;
  isCutShort: boolean;
  /** Least and greatest strain. */
  least: number;
  greatest: number;
}

function lift(shader: { vertexShader: string }): void {
  shader.vertexShader = shader.vertexShader.replace("#include <project_vertex>", `#include <project_vertex>\n gl_Position.z -= ${OVER} * gl_Position.w;`);
}

export class SpringView {
  readonly group = new THREE.Group();
  /** The region whose springs are shown. */
  region: number | null = null;
  private readonly known = new Map<string, Springs>();
  private readonly material = new THREE.LineBasicMaterial({ vertexColors: true });
  private lines: THREE.LineSegments | null = null;
  private shown: Springs | null = null;
  private rest = new Float32Array(0);
  private strains = new Float32Array(0);
  /** Springs of node i: `springs[starts[i]]` to `springs[starts[i + 1] - 1]`. */
  private starts = new Uint32Array(0);
  private springs = new Uint32Array(0);
  private mark = new Uint8Array(0);

  constructor(private readonly tissue: Tissue) {
    this.material.onBeforeCompile = lift;
  }


  /** Takes springs from the host. */
  add(springs: Springs): void {
    this.known.set(`${springs.version} ${springs.region}`, springs);
    this.display();
  }

  /** Forgets all springs; a new connection names them again. */
  forget(): void {
    this.known.clear();
  }

  setClip(plane: THREE.Plane | null): void {
    this.material.clippingPlanes = plane === null ? null : [plane];
  }

  /** Displays the springs of the selected region and the displayed topology, if they have come. */
  display(): void {
    const surface = this.tissue.surface;
    for (const [key, { version }] of this.known) if (surface !== null && version < surface.version) this.known.delete(key);
    const springs = this.known.get(`${surface?.version} ${this.region}`) ?? null;
    // A surface at rest replaces the nodes, so its springs are laid out again.
    this.clear();
    if (surface === null || springs === null || !springs.ends.every((end) => 3 * end < surface.rest.length)) return;
    this.lay(springs, surface.rest);
    this.update(null);
  }

  private clear(): void {
    this.lines?.geometry.dispose();
    this.group.clear();
    this.lines = this.shown = null;
  }

  private lay(springs: Springs, rest: Float32Array): void {
    const { ends } = springs;
    const count = ends.length / 2;
    this.shown = springs;
    this.rest = new Float32Array(count);
    this.strains = new Float32Array(count);
    this.mark = new Uint8Array(count);
    this.starts = new Uint32Array(rest.length / 3 + 1);
    for (const end of ends) this.starts[end + 1]++;
    for (let i = 1; i < this.starts.length; i++) this.starts[i] += this.starts[i - 1];
    this.springs = new Uint32Array(ends.length);
    const next = this.starts.slice();
    ends.forEach((end, i) => (this.springs[next[end]++] = i >> 1));
    for (let i = 0; i < count; i++) this.rest[i] = distance(rest, ends[2 * i], ends[2 * i + 1]);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(6 * count), 3).setUsage(THREE.DynamicDrawUsage));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Uint8Array(6 * count), 3, true).setUsage(THREE.DynamicDrawUsage));
    this.lines = new THREE.LineSegments(geometry, this.material);
    this.lines.frustumCulled = false;
    this.group.add(this.lines);
  }

  /** Follows nodes that moved (all if null). */
  update(moved: Uint32Array | null): void {
    const nodes = this.tissue.nodes;
    if (this.lines === null || this.shown === null || nodes === null) return;
    if (moved !== null) for (const node of moved) for (let s = this.starts[node]; s < this.starts[node + 1]; s++) this.mark[this.springs[s]] = 1;
    const { ends } = this.shown;
    const position = this.lines.geometry.getAttribute("position") as THREE.BufferAttribute;
    const colour = this.lines.geometry.getAttribute("color") as THREE.BufferAttribute;
    let ranges: [number, number][] = [];
    for (let i = 0; i < this.mark.length; i++) {
      if (moved !== null && this.mark[i] === 0) continue;
      this.mark[i] = 0;
      const [a, b] = [ends[2 * i], ends[2 * i + 1]];
      for (let k = 0; k < 3; k++) {
        position.array[6 * i + k] = nodes[3 * a + k];
        position.array[6 * i + 3 + k] = nodes[3 * b + k];
      }
      this.strains[i] = this.rest[i] > 0 ? distance(nodes, a, b) / this.rest[i] - 1 : 0;
      const rgb = strainLight(this.strains[i]);
      for (let k = 0; k < 6; k++) colour.array[6 * i + k] = rgb[k % 3];
      const last = ranges.at(-1);
      if (last !== undefined && i - last[1] <= GAP) last[1] = i + 1;
      else ranges.push([i, i + 1]);
    }
    if (ranges.length === 0) return;
    if (ranges.length > RANGES_MAX) ranges = [[ranges[0][0], ranges[ranges.length - 1][1]]];
    for (const attribute of [position, colour]) {
      // Ranges that no picture has taken yet would pile up in a hidden page.
      if (attribute.updateRanges.length > 4 * RANGES_MAX) {
        attribute.clearUpdateRanges();
        attribute.addUpdateRange(0, attribute.array.length);
      }
      for (const [start, end] of ranges) attribute.addUpdateRange(6 * start, 6 * (end - start));
      attribute.needsUpdate = true;
    }
  }

  /** Figures of the displayed springs; null without any. */
  figures(): SpringFigures | null {
    if (this.shown === null) return null;
    let [least, greatest] = [0, 0];
    for (const strain of this.strains) {
      if (strain < least) least = strain;
      else if (strain > greatest) greatest = strain;
    }
    return { count: this.strains.length, isCutShort: this.shown.isCutShort, least, greatest };
  }
}

function distance(nodes: Float32Array, a: number, b: number): number {
  const x = nodes[3 * a] - nodes[3 * b];
  const y = nodes[3 * a + 1] - nodes[3 * b + 1];
  const z = nodes[3 * a + 2] - nodes[3 * b + 2];
  return Math.sqrt(x * x + y * y + z * z);
}
