// The pointer: mouse, touch and keys on the picture move the own tool or the camera. Samples of the tool carry the server's time
// and keep a speed below that of the host's tool.
import * as THREE from "three";
import type { OrbitCamera } from "./camera.ts";
import { SAMPLES_MAX } from "./frames.ts";
import type { Sample, ToolPose } from "./messages.ts";

/** Largest speed of the tool, below the limits of the hosts (0.4 m/s). */
const SPEED_M_S = 0.28;
/** Largest angular speed of the tool, rad/s. */
const TURN_RAD_S = 3;
/** A server's clock that is put back by more than this starts the samples again, µs. */
const CLOCK_JUMP_US = 1e6;
/** Speed by keys, m/s. */
const KEY_SPEED_M_S = 0.04;
const MOVING_MS = 1000 / 120;
const RESTING_MS = 1000 / 30;
/** Depth per notch of the wheel, m. */
const NOTCH_M = 0.002;
/** Angle of the handle away from the line of sight, rad. */
const TILT = 0.3;

export class Pointer {
  private readonly position = new THREE.Vector3();
  private readonly target = new THREE.Vector3();
  private readonly rotation = new THREE.Quaternion();
  private readonly keys = new Set<string>();
  private readonly fingers = new Map<number, { x: number; y: number }>();
  private dragged: "tool" | "orbit" | "pan" | null = null;
  private hasPlace = false;
  private sampled_us = 0;
  private sent_ms = 0;
  private ticked_ms = 0;
  private isKeyHeld = false;
  private isButtonHeld = false;
  /** Whether this participant's tool follows the pointer at all. */
  canSteer = false;
  /** Whether dragging moves the tool, not the camera. */
  movesTool = true;
  onHeld: () => void = () => undefined;
  onClick: (ray: THREE.Ray) => boolean = () => false;

  constructor(
    private readonly canvas: HTMLElement,
    private readonly orbit: OrbitCamera,
    private readonly serverTime_us: () => number | null,
    private readonly send: (samples: Sample[]) => void,
  ) {
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"] as const) canvas.addEventListener(name, (event) => this.release(event));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.key(event, true));
    canvas.addEventListener("keyup", (event) => this.key(event, false));
    canvas.addEventListener("blur", () => this.letGo());
    window.addEventListener("blur", () => this.letGo());
    setInterval(() => this.tick(), MOVING_MS);
  }

  private letGo(): void {
    this.keys.clear();
    this.isKeyHeld = false;
    this.onHeld();
  }

  get isHeld(): boolean {
    return this.canSteer && (this.isKeyHeld || this.isButtonHeld);
  }

  /** Holds or releases the main button, as the switch of the palette does. */
  holdButton(isHeld: boolean): void {
    this.isButtonHeld = isHeld;
    this.onHeld();
  }

  get isMovingTool(): boolean {
    return this.canSteer && this.movesTool;
  }

  get isPlaced(): boolean {
    return this.hasPlace;
  }

  /** Puts the tool at a point without a path, as when it joins. */
  place(x: number, y: number, z: number): void {
    this.position.set(x, y, z);
    this.target.copy(this.position);
    this.rotation.copy(this.facing());
    this.hasPlace = true;
  }

  /** Forgets the place, because the server may have put the tool elsewhere. */
  unplace(): void {
    this.hasPlace = false;
  }

  /** Steers the tool to a point as a drag would. */
  steer(x: number, y: number, z: number): void {
    if (!this.hasPlace) this.place(x, y, z);
    this.target.set(x, y, z);
  }

  /** The pose at present, which the shared tool follows by D, as the ghost of a device; none if the host shows one. */
  ghost(participant: number | null, poses: readonly ToolPose[]): ToolPose[] {
    if (participant === null || !this.canSteer || !this.hasPlace) return [];
    if (poses.some((pose) => pose.is_device && pose.participant === participant)) return [];
    const { x, y, z, w } = this.rotation;
    return [
      {
        participant,
        is_active: true,
        is_device: true,
        is_proxy: false,
        buttons: this.isHeld ? 1 : 0,
        position: this.position.toArray(),
        rotation: [x, y, z, w],
        force: [0, 0, 0],
      },
    ];
  }

  /** The handle points to the viewer and upwards, so that a blade points into the tissue. */
  private facing(): THREE.Quaternion {
    const e = this.orbit.camera.matrixWorld.elements;
    const right = new THREE.Vector3(e[0], e[1], e[2]);
    const handle = this.orbit.forward.negate().applyAxisAngle(right, -TILT).normalize();
    return new THREE.Quaternion().setFromRotationMatrix(new THREE.Matrix4().makeBasis(right, handle.clone().cross(right), handle));
  }

  private ray(event: PointerEvent | MouseEvent): THREE.Ray {
    const box = this.canvas.getBoundingClientRect();
    const x = (2 * (event.clientX - box.left)) / box.width - 1;
    const y = 1 - (2 * (event.clientY - box.top)) / box.height;
    const caster = new THREE.Raycaster();
    caster.setFromCamera(new THREE.Vector2(x, y), this.orbit.camera);
    return caster.ray;
  }

  private press(event: PointerEvent): void {
    this.canvas.focus({ preventScroll: true });
    if (event.button === 0 && this.fingers.size === 0 && this.onClick(this.ray(event))) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (event.button === 2) this.dragged = event.shiftKey ? "pan" : "orbit";
    else if (event.button === 1) this.dragged = "pan";
    else if (event.shiftKey) this.dragged = this.isMovingTool ? "orbit" : "pan";
    else this.dragged = this.isMovingTool ? "tool" : "orbit";
    event.preventDefault();
  }

  private drag(event: PointerEvent): void {
    const finger = this.fingers.get(event.pointerId);
    if (finger === undefined) return;
    const x = event.clientX - finger.x;
    const y = event.clientY - finger.y;
    const height = this.canvas.clientHeight;
    if (this.fingers.size === 2) {
      const [a, b] = [...this.fingers.values()];
      const before = Math.hypot(a.x - b.x, a.y - b.y);
      finger.x = event.clientX;
      finger.y = event.clientY;
      const after = Math.hypot(a.x - b.x, a.y - b.y);
      if (before > 10 && after > 10) this.orbit.zoom(before / after);
      // With the tool under one finger, two fingers turn the view; otherwise they shift it.
      if (this.isMovingTool) this.orbit.orbit(0.004 * x, 0.004 * y);
      else this.orbit.pan(x / 2, y / 2, height);
      return;
    }
    finger.x = event.clientX;
    finger.y = event.clientY;
    if (this.fingers.size > 2) return;
    if (this.dragged === "orbit") this.orbit.orbit(0.008 * x, 0.008 * y);
    else if (this.dragged === "pan") this.orbit.pan(x, y, height);
    else if (this.dragged === "tool" && this.hasPlace) {
      const depth = this.target.clone().sub(this.orbit.camera.position).dot(this.orbit.forward);
      this.target.add(this.orbit.inPlane(x, y, Math.max(depth, 0.01), height));
    }
  }

  private release(event: PointerEvent): void {
    this.fingers.delete(event.pointerId);
    if (this.fingers.size === 0) this.dragged = null;
  }

  private wheel(event: WheelEvent): void {
    event.preventDefault();
    const notches = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY / 100 : event.deltaY / 3;
    const bounded = Math.max(-3, Math.min(3, notches));
    if (this.isMovingTool && !event.ctrlKey && !event.shiftKey) this.deepen(-bounded * NOTCH_M);
    else this.orbit.zoom(1.15 ** (event.shiftKey && event.deltaY === 0 ? Math.sign(event.deltaX) : bounded));
  }

  /** Moves the tool away from the viewer, m. */
  deepen(distance: number): void {
    if (this.hasPlace) this.target.addScaledVector(this.orbit.forward, distance);
  }

  private key(event: KeyboardEvent, isDown: boolean): void {
    const steers = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "PageUp", "PageDown"];
    if (event.code === "Space") {
      event.preventDefault();
      this.isKeyHeld = isDown;
      this.onHeld();
    } else if (steers.includes(event.key) && !event.ctrlKey && !event.metaKey) {
      event.preventDefault();
      if (isDown && (event.shiftKey || event.altKey || !this.isMovingTool)) this.turn(event);
      else if (isDown) this.keys.add(event.key);
      if (!isDown) this.keys.delete(event.key);
    } else if (isDown && (event.key === "+" || event.key === "-")) {
      this.orbit.zoom(event.key === "+" ? 1 / 1.15 : 1.15);
    }
  }

  /** Arrow keys on the camera: orbit, or pan with Alt. */
  private turn(event: KeyboardEvent): void {
    const x = Number(event.key === "ArrowRight") - Number(event.key === "ArrowLeft");
    const y = Number(event.key === "ArrowDown") - Number(event.key === "ArrowUp");
    if (event.key === "PageUp" || event.key === "PageDown") this.orbit.zoom(event.key === "PageDown" ? 1 / 1.15 : 1.15);
    else if (event.altKey) this.orbit.pan(-20 * x, -20 * y, this.canvas.clientHeight);
    else this.orbit.orbit(0.09 * x, 0.09 * y);
  }

  private applyKeys(seconds: number): void {
    if (this.keys.size === 0 || !this.hasPlace) return;
    const axis = (plus: string, minus: string): number => Number(this.keys.has(plus)) - Number(this.keys.has(minus));
    const e = this.orbit.camera.matrixWorld.elements;
    const step = new THREE.Vector3()
      .addScaledVector(new THREE.Vector3(e[0], e[1], e[2]), axis("ArrowRight", "ArrowLeft"))
      .addScaledVector(new THREE.Vector3(e[4], e[5], e[6]), axis("ArrowUp", "ArrowDown"))
      .addScaledVector(this.orbit.forward, axis("PageDown", "PageUp"));
    this.target.addScaledVector(step, KEY_SPEED_M_S * seconds);
  }

  /** Moves the tool towards its target and sends samples: 120 per second while it moves, 30 at rest. */
  private tick(): void {
    const now_ms = performance.now();
    const passed_ms = Math.min(now_ms - this.ticked_ms, SAMPLES_MAX * MOVING_MS);
    this.ticked_ms = now_ms;
    const time_us = this.serverTime_us();
    // Another server, or one that was restarted, has another clock.
    if (time_us !== null && this.sampled_us > time_us + CLOCK_JUMP_US) this.sampled_us = time_us;
    if (!this.canSteer || !this.hasPlace || time_us === null) return;
    this.applyKeys(passed_ms / 1000);
    const aim = this.isHeld ? this.rotation : this.facing();
    const isMoving = this.position.distanceTo(this.target) > 1e-6 || this.rotation.angleTo(aim) > 1e-3;
    if (!isMoving && now_ms - this.sent_ms < RESTING_MS) return;
    this.sent_ms = now_ms;
    // A busy page ticks late; the samples in between keep the path smooth.
    const count = isMoving ? Math.max(1, Math.min(SAMPLES_MAX, Math.round(passed_ms / MOVING_MS))) : 1;
    const samples: Sample[] = [];
    for (let i = 1; i <= count; i++) {
      const at_us = time_us - ((count - i) / count) * 1000 * passed_ms;
      if (at_us <= this.sampled_us && count > 1 && i < count) continue;
      const stamp_us = Math.max(at_us, this.sampled_us + 500);
      const seconds = Math.max(0, Math.min((stamp_us - this.sampled_us) / 1e6, passed_ms / 1000));
      const left = this.position.distanceTo(this.target);
      this.position.lerp(this.target, left > SPEED_M_S * seconds ? (SPEED_M_S * seconds) / left : 1);
      this.rotation.rotateTowards(aim, TURN_RAD_S * seconds);
      this.sampled_us = stamp_us;
      const { x, y, z, w } = this.rotation;
      samples.push({ time_us: stamp_us, position: this.position.toArray(), rotation: [x, y, z, w], buttons: this.isHeld ? 1 : 0 });
    }
    if (samples.length > 0) this.send(samples);
  }
}
