// Preview of strokes: the sheet that the edge of a blade has passed while its button is held.
import * as THREE from "three";
import type { Participant, ToolPose } from "./messages.ts";

const POINTS_MAX = 1024;
/** Distance of the tip between two points of the preview, m. */
const SPACING_M = 5e-4;
/** A finished stroke stays so long, because its cut takes effect later, ms. */
const STAYS_MS = 1500;

interface Stroke {
  mesh: THREE.Mesh;
  count: number;
  last: THREE.Vector3;
  ended_ms: number | null;
}

export class StrokeView {
  readonly group = new THREE.Group();
  private readonly strokes = new Map<number, Stroke>();

  private start(participant: number): Stroke {
    this.remove(participant);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(6 * POINTS_MAX), 3));
    const index: number[] = [];
    for (let i = 0; i + 1 < POINTS_MAX; i++) index.push(2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 1, 2 * i + 3, 2 * i + 2);
    geometry.setIndex(index);
    const material = new THREE.MeshBasicMaterial({
      color: 0xff2d46,
      transparent: true,
      opacity: 0.45,
      side: THREE.DoubleSide,
      depthTest: false,
      depthWrite: false,
    });
    const mesh = new THREE.Mesh(geometry, material);
    mesh.frustumCulled = false;
    mesh.renderOrder = 5;
    this.group.add(mesh);
    const stroke = { mesh, count: 0, last: new THREE.Vector3(), ended_ms: null };
    this.strokes.set(participant, stroke);
    return stroke;
  }

  private remove(participant: number): void {
    const stroke = this.strokes.get(participant);
    if (stroke === undefined) return;
    stroke.mesh.geometry.dispose();
    (stroke.mesh.material as THREE.Material).dispose();
    this.group.remove(stroke.mesh);
    this.strokes.delete(participant);
  }

  /** Removes finished strokes, whose cuts now show. */
  clearFinished(): void {
    for (const [participant, stroke] of [...this.strokes]) if (stroke.ended_ms !== null) this.remove(participant);
  }

  show(poses: readonly ToolPose[], participants: readonly Participant[], now_ms: number): void {
    const cutting = new Set<number>();
    for (const pose of poses) {
      const tool = participants.find((p) => p.id === pose.participant)?.tool;
      const isCutting = pose.is_active && !pose.is_device && !pose.is_proxy && (pose.buttons & 1) !== 0 && tool?.kind === "blade";
      if (!isCutting) continue;
      cutting.add(pose.participant);
      let stroke = this.strokes.get(pose.participant);
      if (stroke === undefined || stroke.ended_ms !== null) stroke = this.start(pose.participant);
      const tip = new THREE.Vector3(...pose.position);
      if ((stroke.count > 0 && tip.distanceTo(stroke.last) < SPACING_M) || stroke.count === POINTS_MAX) continue;
      const top = new THREE.Vector3(0, 0, tool.length_mm / 1000).applyQuaternion(new THREE.Quaternion(...pose.rotation)).add(tip);
      const positions = stroke.mesh.geometry.getAttribute("position") as THREE.BufferAttribute;
      positions.setXYZ(2 * stroke.count, ...tip.toArray());
      positions.setXYZ(2 * stroke.count + 1, ...top.toArray());
      positions.needsUpdate = true;
      stroke.last.copy(tip);
      stroke.count++;
      stroke.mesh.geometry.setDrawRange(0, 6 * (stroke.count - 1));
    }
    for (const [participant, stroke] of [...this.strokes]) {
      if (!cutting.has(participant)) stroke.ended_ms ??= now_ms;
      if (stroke.ended_ms !== null && now_ms - stroke.ended_ms > STAYS_MS) this.remove(participant);
    }
  }
}
