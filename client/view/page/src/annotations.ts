// Annotations: pins and arrows with text that follow the deformation through three nodes of the tissue and their weights.
import * as THREE from "three";
import type { Labels } from "./labels.ts";
import type { Annotation } from "./messages.ts";
import type { Tissue } from "./tissue.ts";

const COLOUR = "#e0a100";

interface Mark {
  root: THREE.Group;
  kind: string;
}

export class AnnotationView {
  readonly group = new THREE.Group();
  private readonly marks = new Map<number, Mark>();
  private readonly material = new THREE.MeshBasicMaterial({ color: COLOUR });

  constructor(private readonly labels: Labels) {}

  private mark(annotation: Annotation, thickness: number): THREE.Group {
    const known = this.marks.get(annotation.id);
    if (known?.kind === annotation.kind) return known.root;
    if (known !== undefined) this.remove(annotation.id);
    const root = new THREE.Group();
    // Along y from the tissue at 0 to the text at 1; the shaft is stretched, the end keeps its form.
    const shaft = new THREE.Mesh(new THREE.CylinderGeometry(0.35, 0.35, 1, 8).translate(0, 0.5, 0), this.material);
    const end = new THREE.Mesh(
      annotation.kind === "pin" ? new THREE.SphereGeometry(1.5, 16, 12) : new THREE.ConeGeometry(1.6, 4, 16).translate(0, -2, 0).rotateX(Math.PI),
      this.material,
    );
    end.scale.setScalar(thickness);
    root.add(shaft, end);
    this.group.add(root);
    this.marks.set(annotation.id, { root, kind: annotation.kind });
    return root;
  }

  private remove(id: number): void {
    const mark = this.marks.get(id);
    if (mark === undefined) return;
    for (const child of mark.root.children) (child as THREE.Mesh).geometry.dispose();
    this.group.remove(mark.root);
    this.marks.delete(id);
  }

  show(annotations: readonly Annotation[], tissue: Tissue, size_m: number): void {
    const thickness = 0.007 * size_m;
    for (const annotation of annotations) {
      const foot = tissue.point(annotation.nodes, annotation.weights);
      if (foot === null) {
        // The place was cut away.
        this.remove(annotation.id);
        continue;
      }
      const offset = new THREE.Vector3(...annotation.offset_m);
      const length = Math.max(offset.length(), 1e-4);
      const root = this.mark(annotation, thickness);
      root.position.copy(foot);
      root.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), offset.clone().normalize());
      const [shaft, end] = root.children;
      shaft.scale.set(thickness, length, thickness);
      end.position.y = annotation.kind === "pin" ? length : 0;
      const name = annotation.text === "" ? "" : annotation.text.slice(0, 200);
      if (name !== "") this.labels.put(`note ${annotation.id}`, annotation.kind, name, COLOUR, foot.add(offset), 10, -10);
    }
    for (const id of [...this.marks.keys()]) if (!annotations.some((a) => a.id === id)) this.remove(id);
  }
}
