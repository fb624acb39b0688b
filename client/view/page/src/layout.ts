// Layout of a surface in vertex buffers. Each region has a closed surface: its own faces and, mirrored, the faces of interfaces
// that belong to its neighbours. Outer faces, wounds and interfaces have vertices of their own, so that edges between them
// stay sharp.
import type { Surface } from "./messages.ts";

export type PartKind = "outer" | "wound" | "interface";

/** Faces of one region of one kind, drawn at once. */
export interface SurfacePart {
  region: number;
  /** The region on the other side of an interface. */
  other: number | null;
  kind: PartKind;
  /** Three vertices per face. */
  index: Uint32Array<ArrayBuffer>;
}

/** Rows of values: those of row i are `values[starts[i]]` to `values[starts[i + 1] - 1]`. */
interface Rows {
  starts: Uint32Array;
  values: Uint32Array;
}

function rows(count: number, pairs: (add: (row: number, value: number) => void) => void): Rows {
  const starts = new Uint32Array(count + 1);
  pairs((row) => starts[row + 1]++);
  for (let i = 0; i < count; i++) starts[i + 1] += starts[i];
  const values = new Uint32Array(starts[count]);
  const next = starts.slice();
  pairs((row, value) => (values[next[row]++] = value));
  return { starts, values };
}

/** Class of faces over which normals are smoothed: outer surface, wounds, and one per interface. */
const OUTER = 0;
const WOUND = 1;

export class Layout {
  readonly parts: SurfacePart[] = [];
  /** Node of each vertex. */
  readonly vertexNode: Uint32Array;
  /** Part of each vertex. */
  readonly vertexPart: Uint16Array;
  private readonly vertexClass: Uint16Array;
  private readonly vertexSign: Int8Array;
  private readonly faceClass: Uint16Array;
  private readonly nodeVertices: Rows;
  private readonly nodeFaces: Rows;
  /** Positions and normals, three components per vertex. */
  readonly positions: Float32Array<ArrayBuffer>;
  readonly normals: Float32Array<ArrayBuffer>;
  private readonly faceNormals: Float32Array;
  private readonly faceMark: Uint8Array;
  private readonly nodeMark: Uint8Array;
  /** Positions of the nodes, three components per node. */
  readonly nodes: Float32Array;
  /** Vertices changed since the last call of `takeChanges`. */
  private readonly vertexMark: Uint8Array;

  constructor(readonly surface: Surface) {
    const { triangles, groups, rest } = surface;
    const nodeCount = rest.length / 3;
    const faceCount = triangles.length / 3;
    this.faceClass = new Uint16Array(faceCount);
    const classes = new Map<string, number>();
    const found = new Map<string, { part: Omit<SurfacePart, "index">; class: number; sign: 1 | -1; faces: [number, number][] }>();
    for (const group of groups) {
      const kind: PartKind = group.is_wound ? "wound" : group.other === null ? "outer" : "interface";
      let faceClass = kind === "outer" ? OUTER : WOUND;
      if (kind === "interface") {
        const pair = `${group.region} ${group.other}`;
        faceClass = classes.get(pair) ?? 2 + classes.size;
        classes.set(pair, faceClass);
      }
      this.faceClass.fill(faceClass, group.start, group.start + group.count);
      const put = (region: number, other: number | null, sign: 1 | -1): void => {
        const key = `${region} ${other} ${kind}`;
        const entry = found.get(key) ?? { part: { region, other, kind }, class: faceClass, sign, faces: [] };
        entry.faces.push([group.start, group.count]);
        found.set(key, entry);
      };
      put(group.region, group.other, 1);
      if (group.other !== null) put(group.other, group.region, -1);
    }
    const vertexNode: number[] = [];
    const vertexPart: number[] = [];
    const vertexClass: number[] = [];
    const vertexSign: number[] = [];
    const vertexOf = new Int32Array(nodeCount);
    for (const { part, class: faceClass, sign, faces } of found.values()) {
      vertexOf.fill(-1);
      let size = 0;
      for (const [start, count] of faces) {
        for (let i = 3 * start; i < 3 * (start + count); i++) vertexOf[triangles[i]] = 0;
        size += 3 * count;
      }
      for (let node = 0; node < nodeCount; node++) {
        if (vertexOf[node] < 0) continue;
        vertexOf[node] = vertexNode.length;
        vertexNode.push(node);
        vertexPart.push(this.parts.length);
        vertexClass.push(faceClass);
        vertexSign.push(sign);
      }
      const index = new Uint32Array(size);
      let at = 0;
      for (const [start, count] of faces) {
        for (let face = start; face < start + count; face++) {
          index[at++] = vertexOf[triangles[3 * face]];
          index[at++] = vertexOf[triangles[3 * face + (sign > 0 ? 1 : 2)]];
          index[at++] = vertexOf[triangles[3 * face + (sign > 0 ? 2 : 1)]];
        }
      }
      this.parts.push({ ...part, index });
    }
    this.vertexNode = Uint32Array.from(vertexNode);
    this.vertexPart = Uint16Array.from(vertexPart);
    this.vertexClass = Uint16Array.from(vertexClass);
    this.vertexSign = Int8Array.from(vertexSign);
    this.nodeVertices = rows(nodeCount, (add) => this.vertexNode.forEach((node, vertex) => add(node, vertex)));
    this.nodeFaces = rows(nodeCount, (add) => triangles.forEach((node, corner) => add(node, Math.floor(corner / 3))));
    this.positions = new Float32Array(3 * vertexNode.length);
    this.normals = new Float32Array(3 * vertexNode.length);
    this.faceNormals = new Float32Array(3 * faceCount);
    this.faceMark = new Uint8Array(faceCount);
    this.nodeMark = new Uint8Array(nodeCount);
    this.vertexMark = new Uint8Array(vertexNode.length);
    this.nodes = rest.slice();
    this.update(new Float32Array(rest.length), null);
  }

  /** Moves nodes (all if null) to their displacements and recomputes the normals around them. */
  update(displacements: Float32Array, moved: Uint32Array | null): void {
    const { rest, triangles } = this.surface;
    const count = moved?.length ?? rest.length / 3;
    for (let i = 0; i < count; i++) {
      const node = moved === null ? i : moved[i];
      for (let k = 3 * node; k < 3 * node + 3; k++) this.nodes[k] = rest[k] + displacements[k];
      for (let f = this.nodeFaces.starts[node]; f < this.nodeFaces.starts[node + 1]; f++) {
        const face = this.nodeFaces.values[f];
        if (moved !== null) this.faceMark[face] = 1;
      }
      for (let v = this.nodeVertices.starts[node]; v < this.nodeVertices.starts[node + 1]; v++) {
        this.positions.set(this.nodes.subarray(3 * node, 3 * node + 3), 3 * this.nodeVertices.values[v]);
      }
    }
    for (let face = 0; face < this.faceMark.length; face++) {
      if (moved !== null && this.faceMark[face] === 0) continue;
      this.faceMark[face] = 0;
      this.turn(face);
      for (let k = 0; k < 3; k++) this.nodeMark[triangles[3 * face + k]] = 1;
    }
    for (let node = 0; node < this.nodeMark.length; node++) {
      if (this.nodeMark[node] === 0) continue;
      this.nodeMark[node] = 0;
      for (let v = this.nodeVertices.starts[node]; v < this.nodeVertices.starts[node + 1]; v++) {
        this.smooth(node, this.nodeVertices.values[v]);
      }
    }
  }

  /** The normal of a face, as long as twice its area. */
  private turn(face: number): void {
    const [a, b, c] = [0, 1, 2].map((k) => 3 * this.surface.triangles[3 * face + k]);
    const n = this.nodes;
    const ux = n[b] - n[a];
    const uy = n[b + 1] - n[a + 1];
    const uz = n[b + 2] - n[a + 2];
    const vx = n[c] - n[a];
    const vy = n[c + 1] - n[a + 1];
    const vz = n[c + 2] - n[a + 2];
    this.faceNormals[3 * face] = uy * vz - uz * vy;
    this.faceNormals[3 * face + 1] = uz * vx - ux * vz;
    this.faceNormals[3 * face + 2] = ux * vy - uy * vx;
  }

  private smooth(node: number, vertex: number): void {
    let x = 0;
    let y = 0;
    let z = 0;
    for (let f = this.nodeFaces.starts[node]; f < this.nodeFaces.starts[node + 1]; f++) {
      const face = this.nodeFaces.values[f];
      if (this.faceClass[face] !== this.vertexClass[vertex]) continue;
      x += this.faceNormals[3 * face];
      y += this.faceNormals[3 * face + 1];
      z += this.faceNormals[3 * face + 2];
    }
    const scale = this.vertexSign[vertex] / (Math.hypot(x, y, z) || 1);
    this.normals[3 * vertex] = scale * x;
    this.normals[3 * vertex + 1] = scale * y;
    this.normals[3 * vertex + 2] = scale * z;
    this.vertexMark[vertex] = 1;
  }

  /** Ranges [start, count] of vertices that changed since the last call; ranges with a gap of at most `gap` are joined. */
  takeChanges(gap: number): [number, number][] {
    const ranges: [number, number][] = [];
    let end = Number.NEGATIVE_INFINITY;
    for (let vertex = 0; vertex < this.vertexMark.length; vertex++) {
      if (this.vertexMark[vertex] === 0) continue;
      this.vertexMark[vertex] = 0;
      const last = ranges.at(-1);
      if (last !== undefined && vertex - end <= gap) last[1] = vertex + 1 - last[0];
      else ranges.push([vertex, 1]);
      end = vertex;
    }
    return ranges;
  }
}
