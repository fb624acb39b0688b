// Forces on tools as arrows with newtons, and contact points with the force at each. An arrow has a dark rim, which
// separates it from the tool of the same colour.
import * as THREE from "three";
import type { Labels } from "./labels.ts";
import type { Participant, Reaction, ToolPose } from "./messages.ts";
import { ownerColour } from "./tools.ts";

/** Forces below this are not drawn, N. */
const LEAST_N = 0.02;
/** The longest arrow, in parts of the size of the model. */
const LONGEST = 0.4;
/** An arrow of this force has 63 % of that length, N. Small forces stay visible, and large ones in the picture. */
const TYPICAL_N = 2;
/** Length of the line at a contact point per newton, in parts of the size of the model. */
const PER_NEWTON = 0.09;
const RIM = 0x10161d;
/** Width of the rim, in parts of the radius of the shaft. */
const RIM_WIDTH = 0.5;
const POINTS_MAX = 512;

/** A shaft and a head along y, and the same again, wider, for the rim. */
interface Arrow {
  root: THREE.Group;
  shafts: [THREE.Mesh, THREE.Mesh];
  heads: [THREE.Mesh, THREE.Mesh];
}

export class ForceView {
  readonly group = new THREE.Group();
  private readonly arrows = new Map<number, Arrow>();
  private readonly points: THREE.Points;
  private readonly lines: THREE.LineSegments;
  /** Size of the model, m. */
  size_m = 0.2;
  isShown = true;

  constructor(private readonly labels: Labels) {
    const points = new THREE.BufferGeometry();
    points.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * POINTS_MAX), 3));
    const lines = new THREE.BufferGeometry();
    lines.setAttribute("position", new THREE.BufferAttribute(new Float32Array(6 * POINTS_MAX), 3));
    const over = { depthTest: false, transparent: true };
    this.points = new THREE.Points(points, new THREE.PointsMaterial({ color: 0xffd43b, size: 6, sizeAttenuation: false, ...over }));
    this.lines = new THREE.LineSegments(lines, new THREE.LineBasicMaterial({ color: 0xffd43b, opacity: 0.9, ...over }));
    for (const object of [this.points, this.lines]) {
      object.frustumCulled = false;
      object.renderOrder = 10;
      this.group.add(object);
    }
  }

  private arrow(participant: number): Arrow {
    const known = this.arrows.get(participant);
    if (known !== undefined) return known;
    const shaft = new THREE.CylinderGeometry(1, 1, 1, 12).translate(0, 0.5, 0);
    const head = new THREE.ConeGeometry(1, 1, 16).translate(0, -0.5, 0);
    const root = new THREE.Group();
    const fill = ownerColour(participant);
    const pair = (geometry: THREE.BufferGeometry): [THREE.Mesh, THREE.Mesh] => {
      const [inner, outer] = [fill, RIM].map((color, i) => {
        const mesh = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ color, depthTest: false, transparent: true }));
        mesh.renderOrder = 10 - i;
        root.add(mesh);
        return mesh;
      });
      return [inner, outer];
    };
    const arrow: Arrow = { root, shafts: pair(shaft), heads: pair(head) };
    this.group.add(root);
    this.arrows.set(participant, arrow);
    return arrow;
  }

  /** Shows forces at the displayed time. */
  show(poses: readonly ToolPose[], participants: readonly Participant[], reactions: readonly Reaction[]): void {
    this.group.visible = this.isShown;
    if (!this.isShown) return;
    const seen = new Set<number>();
    const width = 0.006 * this.size_m;
    for (const pose of poses) {
      if (!pose.is_active || pose.is_device || seen.has(pose.participant)) continue;
      const force = new THREE.Vector3(...pose.force);
      const newtons = force.length();
      if (newtons < LEAST_N) continue;
      seen.add(pose.participant);
      const length = LONGEST * (1 - Math.exp(-newtons / TYPICAL_N)) * this.size_m;
      const { root, shafts, heads } = this.arrow(pose.participant);
      root.visible = true;
      // The arrow begins at the surface of the tool, which would hide a short one.
      const radius = (participants.find((p) => p.id === pose.participant)?.tool?.radius_mm ?? 0) / 1000;
      root.position.set(...pose.position).addScaledVector(force.normalize(), radius);
      root.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), force);
      const tip = Math.min(4 * width, 0.6 * length);
      for (const [i, rim] of [0, RIM_WIDTH * width].entries()) {
        shafts[i].scale.set(width + rim, Math.max(length - tip, 1e-6), width + rim);
        heads[i].scale.set(2.4 * width + 2 * rim, tip + 3 * rim, 2.4 * width + 2 * rim);
        heads[i].position.y = length + 2 * rim;
      }
      const end = root.position.clone().addScaledVector(force, length);
      this.labels.put(`force ${pose.participant}`, "force", `${newtons.toFixed(2)}\u202fN`, ownerColour(pose.participant), end, 8, -6);
    }
    for (const [participant, arrow] of this.arrows) if (!seen.has(participant)) arrow.root.visible = false;
    this.contacts(reactions);
  }

  private contacts(reactions: readonly Reaction[]): void {
    const points = this.points.geometry.getAttribute("position") as THREE.BufferAttribute;
    const lines = this.lines.geometry.getAttribute("position") as THREE.BufferAttribute;
    let count = 0;
    for (const reaction of reactions) {
      for (const { position, force } of reaction.points) {
        if (count === POINTS_MAX) break;
        points.setXYZ(count, ...position);
        lines.setXYZ(2 * count, ...position);
        const scale = PER_NEWTON * this.size_m;
        lines.setXYZ(2 * count + 1, position[0] + scale * force[0], position[1] + scale * force[1], position[2] + scale * force[2]);
        count++;
      }
    }
    this.points.geometry.setDrawRange(0, count);
    this.lines.geometry.setDrawRange(0, 2 * count);
    if (count > 0) points.needsUpdate = lines.needsUpdate = true;
  }
}
