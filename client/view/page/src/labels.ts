// Labels over the picture: text beside points of the scene, kept inside the picture and off each other.
import * as THREE from "three";
import { make, setText } from "./element.ts";

/** Points farther outside have no label; the picture ends at 1. */
const OUTSIDE = 1.1;

interface Label {
  element: HTMLElement;
  isUsed: boolean;
  width: number;
  height: number;
  /** Place wanted in this picture and place set last, in pixels. */
  x: number;
  y: number;
  setX: number;
  setY: number;
}

export class Labels {
  private readonly labels = new Map<string, Label>();
  private readonly projected = new THREE.Vector3();

  constructor(
    private readonly layer: HTMLElement,
    private readonly camera: THREE.Camera,
  ) {}

  /** Starts a picture: labels that are not put before `end` go away. */
  begin(): void {
    for (const label of this.labels.values()) label.isUsed = false;
  }

  /** Puts a label at a point; `x` and `y` shift it, in pixels. */
  put(key: string, kind: string, text: string, colour: string, point: THREE.Vector3, x = 0, y = 0): void {
    const { x: right, y: up, z: depth } = this.projected.copy(point).project(this.camera);
    if (Math.abs(depth) > 1 || Math.max(Math.abs(right), Math.abs(up)) > OUTSIDE) return;
    let label = this.labels.get(key);
    if (label === undefined) {
      const element = make("div", { class: `label ${kind}` });
      label = { element, isUsed: true, width: 0, height: 0, x: 0, y: 0, setX: Number.NaN, setY: Number.NaN };
      label.element.style.setProperty("--owner", colour);
      this.layer.append(label.element);
      this.labels.set(key, label);
    }
    label.isUsed = true;
    // Digits are equally wide, so only another length can change the size.
    const isOther = label.element.textContent?.length !== text.length;
    setText(label.element, text);
    if (isOther) {
      label.width = label.element.offsetWidth;
      label.height = label.element.offsetHeight;
    }
    const { clientWidth, clientHeight } = this.layer;
    const inside = (at: number, size: number, room: number): number => Math.max(2, Math.min(room - size - 2, at));
    label.x = inside((0.5 + 0.5 * this.projected.x) * clientWidth + x, label.width, clientWidth);
    label.y = inside((0.5 - 0.5 * this.projected.y) * clientHeight + y, label.height, clientHeight);
  }

  /** Ends a picture: labels that cover one above them move below it. */
  end(): void {
    const placed: Label[] = [];
    for (const [key, label] of this.labels) {
      if (!label.isUsed) {
        label.element.remove();
        this.labels.delete(key);
        continue;
      }
      for (let tries = 0; tries < 4; tries++) {
        const other = placed.find(
          (p) => label.x < p.x + p.width && p.x < label.x + label.width && label.y < p.y + p.height && p.y < label.y + label.height,
        );
        if (other === undefined) break;
        label.y = other.y + other.height + 1;
      }
      placed.push(label);
      const [x, y] = [Math.round(label.x), Math.round(label.y)];
      if (x === label.setX && y === label.setY) continue;
      label.setX = x;
      label.setY = y;
      label.element.style.transform = `translate(${x}px, ${y}px)`;
    }
  }
}
