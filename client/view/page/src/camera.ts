// The camera: orbits a target, with z up. Mouse and touch gestures come from the pointer; keys, buttons and the instructor's
// camera change it as well.
import * as THREE from "three";

export type StandardView = "front" | "back" | "left" | "right" | "top" | "bottom";

/** Direction from the target to the camera and the vector that points up, per standard view. */
const VIEWS: Record<StandardView, [THREE.Vector3Tuple, THREE.Vector3Tuple]> = {
  front: [[0, -1, 0], [0, 0, 1]],
  back: [[0, 1, 0], [0, 0, 1]],
  left: [[-1, 0, 0], [0, 0, 1]],
  right: [[1, 0, 0], [0, 0, 1]],
  top: [[0, 0, 1], [0, 1, 0]],
  bottom: [[0, 0, -1], [0, 1, 0]],
};
const POLE = 0.02;
/** Duration of a change to another view, ms. */
const MOVE_MS = 350;

interface Pose {
  target: THREE.Vector3;
  offset: THREE.Vector3;
  up: THREE.Vector3;
}

export class OrbitCamera {
  readonly camera = new THREE.PerspectiveCamera(32, 1, 0.001, 20);
  private pose: Pose = { target: new THREE.Vector3(), offset: new THREE.Vector3(0.2, -0.4, 0.25), up: new THREE.Vector3(0, 0, 1) };
  private motion: { from: Pose; to: Pose; begun_ms: number } | null = null;
  private bounds = new THREE.Box3(new THREE.Vector3(-0.1, -0.1, -0.1), new THREE.Vector3(0.1, 0.1, 0.1));
  /** Whether the camera changed since the last picture. */
  hasMoved = true;
  private readonly isCalm = matchMedia("(prefers-reduced-motion: reduce)").matches;

  constructor() {
    this.camera.up.set(0, 0, 1);
  }

  resize(width: number, height: number): void {
    this.camera.aspect = width / Math.max(1, height);
    this.camera.updateProjectionMatrix();
    this.hasMoved = true;
  }

  setBounds(bounds: THREE.Box3): void {
    this.bounds = bounds;
  }

  get target(): THREE.Vector3 {
    return this.pose.target;
  }

  get up(): THREE.Vector3 {
    return this.pose.up;
  }

  /** Distance from the camera to its target, m. */
  get distance_m(): number {
    return this.pose.offset.length();
  }

  private fitting(direction: THREE.Vector3, up: THREE.Vector3): Pose {
    const target = this.bounds.getCenter(new THREE.Vector3());
    const tan = Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2));
    const forward = direction.clone().normalize();
    const right = up.clone().cross(forward).normalize();
    const above = forward.clone().cross(right);
    // The distance at which every corner of the box is in the picture.
    let distance = 0.02;
    for (let i = 0; i < 8; i++) {
      const corner = new THREE.Vector3(
        i & 1 ? this.bounds.max.x : this.bounds.min.x,
        i & 2 ? this.bounds.max.y : this.bounds.min.y,
        i & 4 ? this.bounds.max.z : this.bounds.min.z,
      ).sub(target);
      const wide = Math.max(Math.abs(corner.dot(right)) / this.camera.aspect, Math.abs(corner.dot(above))) / tan;
      distance = Math.max(distance, wide + corner.dot(forward));
    }
    return { target, offset: forward.multiplyScalar(1.12 * distance), up: up.clone() };
  }

  private go(to: Pose, isAnimated: boolean): void {
    this.hasMoved = true;
    if (!isAnimated || this.isCalm) {
      this.motion = null;
      this.pose = to;
    } else {
      const { target, offset, up } = this.pose;
      this.motion = { from: { target: target.clone(), offset: offset.clone(), up: up.clone() }, to, begun_ms: performance.now() };
    }
  }

  /** Shows the whole model from an oblique direction (at start) or the present one. */
  fit(isStart = false): void {
    const direction = isStart ? new THREE.Vector3(0.62, -1, 0.72) : this.pose.offset;
    this.go(this.fitting(direction, this.pose.up), !isStart);
  }

  standard(view: StandardView): void {
    const [direction, up] = VIEWS[view];
    this.go(this.fitting(new THREE.Vector3(...direction), new THREE.Vector3(...up)), true);
  }

  /** Goes to a camera of the instructor. */
  show(position: THREE.Vector3Tuple, target: THREE.Vector3Tuple, up: THREE.Vector3Tuple): void {
    const to = { target: new THREE.Vector3(...target), offset: new THREE.Vector3(...position), up: new THREE.Vector3(...up) };
    to.offset.sub(to.target);
    if (to.offset.lengthSq() > 1e-8 && to.up.lengthSq() > 1e-8) this.go(to, true);
  }

  /** Turns around the target, by angles to the right and down. */
  orbit(right: number, down: number): void {
    this.motion = null;
    const { offset, up } = this.pose;
    if (Math.abs(up.z) < 0.9 && Math.abs(offset.clone().normalize().z) > 0.9) {
      // From a view along z the usual up vector returns without a jump.
      offset.addScaledVector(up, -POLE * offset.length());
    }
    up.set(0, 0, 1);
    const spherical = new THREE.Spherical().setFromVector3(new THREE.Vector3(offset.x, offset.z, -offset.y));
    spherical.theta -= right;
    spherical.phi = THREE.MathUtils.clamp(spherical.phi - down, POLE, Math.PI - POLE);
    const turned = new THREE.Vector3().setFromSpherical(spherical);
    offset.set(turned.x, -turned.z, turned.y);
    this.hasMoved = true;
  }

  /** Shifts the target in the plane of the picture, by pixels. */
  pan(x: number, y: number, height: number): void {
    this.motion = null;
    const shift = this.inPlane(x, y, this.distance_m, height);
    this.pose.target.sub(shift);
    this.hasMoved = true;
  }

  /** Brings the camera nearer (below 1) or farther. */
  zoom(factor: number): void {
    this.motion = null;
    const size = this.bounds.getSize(new THREE.Vector3()).length();
    const distance = THREE.MathUtils.clamp(this.distance_m * factor, 0.02 * size, 8 * size);
    this.pose.offset.setLength(distance);
    this.hasMoved = true;
  }

  /** The vector in the scene of a motion by pixels in the plane at a distance. */
  inPlane(x: number, y: number, distance: number, height: number): THREE.Vector3 {
    const perPixel = (2 * distance * Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2))) / Math.max(1, height);
    const e = this.camera.matrixWorld.elements;
    return new THREE.Vector3(e[0], e[1], e[2])
      .multiplyScalar(x * perPixel)
      .addScaledVector(new THREE.Vector3(e[4], e[5], e[6]), -y * perPixel);
  }

  /** The direction of view. */
  get forward(): THREE.Vector3 {
    return this.camera.getWorldDirection(new THREE.Vector3());
  }

  /** Places the camera for a picture. */
  update(now_ms: number): void {
    if (this.motion !== null) {
      const { from, to, begun_ms } = this.motion;
      const t = Math.min(1, Math.max(0, (now_ms - begun_ms) / MOVE_MS));
      const f = t * t * (3 - 2 * t);
      const length = from.offset.length() + f * (to.offset.length() - from.offset.length());
      this.pose.target.lerpVectors(from.target, to.target, f);
      this.pose.offset.lerpVectors(from.offset, to.offset, f);
      if (this.pose.offset.lengthSq() > 1e-12) this.pose.offset.setLength(length);
      this.pose.up.lerpVectors(from.up, to.up, f).normalize();
      if (t === 1) this.motion = null;
      this.hasMoved = true;
    }
    const { target, offset, up } = this.pose;
    this.camera.up.copy(up);
    this.camera.position.copy(target).add(offset);
    this.camera.lookAt(target);
    const size = this.bounds.getSize(new THREE.Vector3()).length();
    const distance = offset.length();
    const near = Math.max(0.05 * distance, distance - 1.5 * size);
    const far = distance + 4 * size;
    if (Math.abs(near - this.camera.near) > 0.02 * near || Math.abs(far - this.camera.far) > 0.02 * far) {
      this.camera.near = near;
      this.camera.far = far;
      this.camera.updateProjectionMatrix();
    }
    this.camera.updateMatrixWorld();
  }
}
