// The tissue: one mesh per part of the surface of each region, and a second one of its back faces that looks like a cap where the
// clipping plane opens it.
import * as THREE from "three";
import { Layout } from "./layout.ts";
import { Pigment, glossOf } from "./materials.ts";
import type { Region, Surface, Vector } from "./messages.ts";

/** Changes with a gap of at most so many vertices are uploaded together. */
const GAP = 256;
/** More ranges than this are uploaded as one. */
const RANGES_MAX = 8;

/** How a region is shown. */
export interface Layer {
  isVisible: boolean;
  /** 1 is opaque. */
  opacity: number;
}

/** A point on the tissue: three nodes of the model, their weights, and the outward normal there. */
export interface Hit {
  nodes: Vector;
  weights: Vector;
  point: Vector;
  normal: Vector;
}

interface Mesh {
  region: number;
  other: number | null;
  front: THREE.Mesh;
  back: THREE.Mesh;
  material: THREE.Material & { opacity: number };
}

/** Diagonal stripes that mark a pinned region, in pixels of the screen so that they stay legible at every distance. */
function hatch(shader: { fragmentShader: string }): void {
  shader.fragmentShader = shader.fragmentShader.replace(
    "#include <color_fragment>",
    "#include <color_fragment>\n if (mod(gl_FragCoord.x + gl_FragCoord.y, 14.0) < 2.5) diffuseColor.rgb *= 0.72;",
  );
}

export class Tissue {
  readonly group = new THREE.Group();
  private layout: Layout | null = null;
  private meshes: Mesh[] = [];
  private positions: THREE.BufferAttribute | null = null;
  private normals: THREE.BufferAttribute | null = null;
  private regions: Region[] = [];
  private clip: THREE.Plane | null = null;
  layers: Layer[] = [];

  constructor(private readonly isSoftware: boolean) {}

  get surface(): Surface | null {
    return this.layout?.surface ?? null;
  }

  /** Displayed positions of the nodes, three components per node, m. */
  get nodes(): Float32Array | null {
    return this.layout?.nodes ?? null;
  }

  setRegions(regions: Region[]): void {
    this.regions = regions;
    this.layers = regions.map((_, i) => this.layers[i] ?? { isVisible: true, opacity: 1 });
  }

  /** Replaces the surface, at rest. */
  setSurface(surface: Surface): void {
    this.dispose();
    const layout = new Layout(surface);
    this.layout = layout;
    this.positions = new THREE.BufferAttribute(layout.positions, 3).setUsage(THREE.DynamicDrawUsage);
    this.normals = new THREE.BufferAttribute(layout.normals, 3).setUsage(THREE.DynamicDrawUsage);
    const colours = new THREE.BufferAttribute(this.paint(layout), 3, true);
    for (const part of layout.parts) {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", this.positions);
      geometry.setAttribute("normal", this.normals);
      geometry.setAttribute("color", colours);
      geometry.setIndex(new THREE.BufferAttribute(part.index, 1));
      const region = this.regions[part.region];
      const isWound = part.kind === "wound";
      const material = this.material(region?.material ?? "", isWound);
      const cap = new THREE.MeshBasicMaterial({ vertexColors: true, side: THREE.BackSide, color: isWound ? 0xffffff : 0xe4e4e4 });
      if (region?.is_pinned === true) for (const m of [material, cap]) m.onBeforeCompile = hatch;
      const front = new THREE.Mesh(geometry, material);
      const back = new THREE.Mesh(geometry, cap);
      for (const mesh of [front, back]) {
        mesh.frustumCulled = false;
        this.group.add(mesh);
      }
      this.meshes.push({ region: part.region, other: part.other, front, back, material });
    }
    layout.takeChanges(0);
    this.show();
  }

  private material(name: string, isWound: boolean): THREE.Material {
    if (this.isSoftware) return new THREE.MeshLambertMaterial({ vertexColors: true });
    const gloss = isWound ? 0.9 : glossOf(name);
    return new THREE.MeshPhongMaterial({
      vertexColors: true,
      specular: new THREE.Color().setScalar(0.22 * gloss),
      shininess: isWound ? 60 : 25,
    });
  }

  private paint(layout: Layout): Uint8Array<ArrayBuffer> {
    const colours = new Uint8Array(layout.positions.length);
    const { vertexNode, vertexPart, parts, surface } = layout;
    const isAtWound = new Uint8Array(surface.rest.length / 3);
    vertexNode.forEach((node, vertex) => (isAtWound[node] ||= parts[vertexPart[vertex]].kind === "wound" ? 1 : 0));
    const pigments = parts.map(({ region, kind }) => {
      const material = this.regions[region]?.material ?? "";
      const [away, near] = kind === "wound" ? (["wall", "wall"] as const) : (["intact", "edge"] as const);
      return [new Pigment(material, away), new Pigment(material, near)];
    });
    vertexNode.forEach((node, vertex) => pigments[vertexPart[vertex]][isAtWound[node]].write(surface.rest, node, colours, 3 * vertex));
    return colours;
  }

  private dispose(): void {
    for (const { front, back, material } of this.meshes) {
      front.geometry.dispose();
      material.dispose();
      (back.material as THREE.Material).dispose();
    }
    this.group.clear();
    this.meshes = [];
  }

  /** Moves nodes (all if null) and marks the changed ranges for the upload. */
  update(displacements: Float32Array, moved: Uint32Array | null): void {
    if (this.layout === null || moved?.length === 0 || displacements.length !== this.layout.nodes.length) return;
    this.layout.update(displacements, moved);
    let ranges = this.layout.takeChanges(GAP);
    if (ranges.length > RANGES_MAX) {
      const [last, count] = ranges[ranges.length - 1];
      ranges = [[ranges[0][0], last + count - ranges[0][0]]];
    }
    for (const attribute of [this.positions!, this.normals!]) {
      // Ranges that no picture has taken yet would pile up in a hidden page.
      if (attribute.updateRanges.length > 4 * RANGES_MAX) {
        attribute.clearUpdateRanges();
        attribute.addUpdateRange(0, attribute.array.length);
      }
      for (const [start, length] of ranges) attribute.addUpdateRange(3 * start, 3 * length);
      attribute.needsUpdate = true;
    }
  }

  /** Opens the tissue along a plane, or closes it. */
  setClip(plane: THREE.Plane | null): void {
    this.clip = plane;
    this.show();
  }

  /** Applies layers and clipping to the meshes. */
  show(): void {
    const planes = this.clip === null ? null : [this.clip];
    for (const { region, other, front, back, material } of this.meshes) {
      const layer = this.layers[region] ?? { isVisible: true, opacity: 1 };
      const beyond = other === null ? undefined : this.layers[other];
      // Also where the plane opens the region before it: its cap lies in front.
      const isCovered = beyond !== undefined && beyond.isVisible && beyond.opacity === 1;
      front.visible = layer.isVisible && !isCovered;
      back.visible = layer.isVisible && this.clip !== null && layer.opacity === 1;
      const isTransparent = layer.opacity < 1;
      if (material.transparent !== isTransparent) material.needsUpdate = true;
      material.transparent = isTransparent;
      material.opacity = layer.opacity;
      material.depthWrite = !isTransparent;
      material.clippingPlanes = planes;
      (back.material as THREE.Material).clippingPlanes = planes;
    }
  }

  /** Corners of the box around the nodes at rest, m. */
  bounds(): THREE.Box3 {
    const box = new THREE.Box3();
    const rest = this.surface?.rest;
    if (rest === undefined || rest.length === 0) return box.set(new THREE.Vector3(-0.05, -0.05, -0.05), new THREE.Vector3(0.05, 0.05, 0.05));
    return box.setFromArray(rest as unknown as number[]);
  }

  /** Index of a node of the model; null if it is not on the surface. */
  indexOf(number: number): number | null {
    const numbers = this.surface?.numbers;
    if (numbers === undefined) return null;
    let [low, high] = [0, numbers.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (numbers[middle] < number) low = middle + 1;
      else high = middle;
    }
    return numbers[low] === number ? low : null;
  }

  /** The displayed position of a weighted mean of nodes of the model; null if one is not on the surface. */
  point(nodes: Vector, weights: Vector): THREE.Vector3 | null {
    const sum = new THREE.Vector3();
    for (let i = 0; i < 3; i++) {
      const index = this.indexOf(nodes[i]);
      if (index === null) return null;
      sum.addScaledVector(new THREE.Vector3().fromArray(this.layout!.nodes, 3 * index), weights[i]);
    }
    return sum;
  }

  /** Distance of a point from the displayed outer surface, m; negative inside. */
  distance(point: Vector): number | null {
    if (this.layout === null) return null;
    const { triangles, groups } = this.layout.surface;
    const triangle = new THREE.Triangle();
    const [from, at, normal] = [new THREE.Vector3(...point), new THREE.Vector3(), new THREE.Vector3()];
    let nearest = Number.POSITIVE_INFINITY;
    let side = 0;
    for (const group of groups) {
      if (group.other !== null) continue;
      for (let corner = 3 * group.start; corner < 3 * (group.start + group.count); corner += 3) {
        [triangle.a, triangle.b, triangle.c].forEach((v, k) => v.fromArray(this.layout!.nodes, 3 * triangles[corner + k]));
        triangle.closestPointToPoint(from, at);
        const distance = at.distanceTo(from);
        const facing = triangle.getNormal(normal).dot(at.sub(from)) / -distance;
        // The nearest edge belongs to two triangles; the one that faces the point decides on which side it is.
        const isNearer = distance < nearest - 1e-9 || (distance < nearest + 1e-9 && Math.abs(facing) > Math.abs(side));
        if (isNearer) [nearest, side] = [distance, facing];
      }
    }
    return Number.isFinite(nearest) ? Math.sign(side) * nearest : null;
  }

  /** The first visible point of the tissue on a ray. */
  pick(ray: THREE.Ray): Hit | null {
    if (this.layout === null) return null;
    const { triangles, numbers, groups } = this.layout.surface;
    const [a, b, c, at] = [0, 1, 2, 3].map(() => new THREE.Vector3());
    let nearest = Number.POSITIVE_INFINITY;
    let hit: Hit | null = null;
    for (const group of groups) {
      const isShown = (region: number | null): boolean => region !== null && this.layers[region]?.isVisible !== false;
      if (!isShown(group.region) && !isShown(group.other)) continue;
      for (let face = group.start; face < group.start + group.count; face++) {
        const corners = [0, 1, 2].map((k) => triangles[3 * face + k]);
        [a, b, c].forEach((v, k) => v.fromArray(this.layout!.nodes, 3 * corners[k]));
        if (ray.intersectTriangle(a, b, c, false, at) === null) continue;
        const distance = at.distanceToSquared(ray.origin);
        if (distance >= nearest || (this.clip !== null && this.clip.distanceToPoint(at) < 0)) continue;
        nearest = distance;
        const weights = THREE.Triangle.getBarycoord(at, a, b, c, new THREE.Vector3()) ?? new THREE.Vector3(1, 0, 0);
        const normal = THREE.Triangle.getNormal(a, b, c, new THREE.Vector3());
        if (normal.dot(ray.direction) > 0) normal.negate();
        hit = {
          nodes: corners.map((corner) => numbers[corner]) as Vector,
          weights: weights.toArray(),
          point: at.toArray(),
          normal: normal.toArray(),
        };
      }
    }
    return hit;
  }
}
