// Tools in their real size, with their owner's colour and name. A shared tool is also drawn faintly where tissue hides it. A
// ghost shows the device of the own tool at present, and an outline its proxy.
import * as THREE from "three";
import { extent_m, parts, usual } from "./form.ts";
import type { Labels } from "./labels.ts";
import type { Participant, Tool, ToolPose } from "./messages.ts";
import { lead, leader, outline } from "./proxy.ts";

/** Colours of owners, legible on light and on dark ground. */
const OWNERS = ["#2f7fd0", "#d9691e", "#2b9a66", "#a24cc4", "#c23b6b", "#8a7a12", "#1295a6", "#6b63d8"];
const STEEL = "#c6ccd2";
/** Radius and length of handles, which take no part in contact, m. */
const HANDLE_RADIUS_M = 0.0028;
const HANDLE_LENGTH_M = 0.06;

export function ownerColour(participant: number): string {
  return OWNERS[participant % OWNERS.length];
}

type Style = "shared" | "device" | "proxy";

interface Shown {
  root: THREE.Group;
  key: string;
  jaws: { mesh: THREE.Object3D; isHeld: boolean }[];
  /** The line from the device to its proxy. */
  leader: THREE.Object3D | null;
}

function along(mesh: THREE.Mesh): THREE.Mesh {
  // Cylinders and capsules of the library lie along y.
  mesh.geometry.rotateX(Math.PI / 2);
  return mesh;
}

/** The meshes of a tool in its own frame. */
function build(tool: Tool, isHeld: boolean, body: THREE.Material, grip: THREE.Material): THREE.Object3D {
  const root = new THREE.Group();
  const radius = tool.radius_mm / 1000;
  const length = tool.length_mm / 1000;
  const handle = (from: number): void => {
    const mesh = along(new THREE.Mesh(new THREE.CylinderGeometry(HANDLE_RADIUS_M, HANDLE_RADIUS_M * 0.8, HANDLE_LENGTH_M, 14), grip));
    mesh.position.z = from + HANDLE_LENGTH_M / 2;
    root.add(mesh);
  };
  const line = (thickness: number): void => {
    const mesh = along(new THREE.Mesh(new THREE.CapsuleGeometry(thickness, length, 6, 14), body));
    mesh.position.z = length / 2;
    root.add(mesh);
  };
  switch (tool.kind) {
    case "ball":
      root.add(new THREE.Mesh(new THREE.SphereGeometry(radius, 28, 18), grip));
      along(root.add(new THREE.Mesh(new THREE.CylinderGeometry(0.0012, 0.0012, 0.03, 10), body)).children[1] as THREE.Mesh);
      root.children[1].position.z = radius + 0.013;
      handle(radius + 0.026);
      break;
    case "needle":
      line(radius);
      handle(length);
      break;
    case "blade": {
      line(radius);
      const back = 0.24 * length;
      const outline = new THREE.Shape([
        new THREE.Vector2(0, 0),
        new THREE.Vector2(back, 0.35 * length),
        new THREE.Vector2(back, length),
        new THREE.Vector2(0, length),
      ]);
      const sheet = new THREE.ExtrudeGeometry(outline, { depth: radius, bevelEnabled: false });
      sheet.translate(0, 0, -radius / 2);
      sheet.rotateX(Math.PI / 2);
      root.add(new THREE.Mesh(sheet, body));
      handle(length);
      root.children[root.children.length - 1].position.x = back / 2;
      break;
    }
    case "plate":
      root.add(new THREE.Mesh(new THREE.BoxGeometry(length + 2 * radius, tool.width_mm / 1000 + 2 * radius, 2 * radius), body));
      handle(radius);
      break;
    case "forceps":
      for (const part of parts(tool, isHeld)) {
        const long = new THREE.Vector3(...part.along);
        const side = new THREE.Vector3(0, 1, 0);
        const half = long.length();
        const jaw = new THREE.Mesh(new THREE.BoxGeometry(2 * radius, 2 * part.across[1] + 2 * radius, 2 * half + 2 * radius), body);
        long.normalize();
        jaw.quaternion.setFromRotationMatrix(new THREE.Matrix4().makeBasis(side.clone().cross(long), side, long));
        jaw.position.set(...part.middle);
        root.add(jaw);
      }
      handle(length);
      break;
  }
  return root;
}

export class ToolView {
  readonly group = new THREE.Group();
  private readonly shown = new Map<string, Shown>();

  constructor(
    private readonly labels: Labels,
    private readonly isSoftware: boolean,
  ) {}

  private materials(participant: number, style: Style): [THREE.Material, THREE.Material] {
    const colour = ownerColour(participant);
    const options = style === "shared" ? {} : { transparent: true, opacity: 0.28, depthWrite: false };
    const make = (tint: string): THREE.Material =>
      this.isSoftware
        ? new THREE.MeshLambertMaterial({ color: tint, ...options })
        : new THREE.MeshPhongMaterial({ color: tint, specular: 0x666666, shininess: 50, ...options });
    return [make(style === "shared" ? STEEL : colour), make(colour)];
  }

  private make(participant: number, style: Style, tool: Tool, key: string): Shown {
    const root = new THREE.Group();
    const [body, grip] = this.materials(participant, style);
    // Blended but not sorted as transparent: it is drawn after the tissue and before the tool, which must not hide itself.
    const hidden = new THREE.MeshBasicMaterial({
      color: ownerColour(participant),
      blending: THREE.CustomBlending,
      blendSrcAlpha: THREE.OneFactor,
      blendDstAlpha: THREE.OneMinusSrcAlphaFactor,
      opacity: 0.3,
      depthFunc: THREE.GreaterDepth,
      depthWrite: false,
    });
    const jaws: Shown["jaws"] = [];
    for (const isHeld of tool.kind === "forceps" ? [false, true] : [false]) {
      const mesh = style === "proxy" ? outline(tool, isHeld) : build(tool, isHeld, body, grip);
      if (style === "shared") {
        const faint = mesh.clone();
        mesh.traverse((child) => (child.renderOrder = 2));
        faint.traverse((child) => {
          child.renderOrder = 1;
          if (child instanceof THREE.Mesh) child.material = hidden;
        });
        mesh.add(faint);
      }
      root.add(mesh);
      if (tool.kind === "forceps") jaws.push({ mesh, isHeld });
    }
    this.group.add(root);
    const line = style === "proxy" ? leader() : null;
    if (line !== null) this.group.add(line);
    return { root, key, jaws, leader: line };
  }

  private remove(name: string): void {
    const old = this.shown.get(name);
    if (old === undefined) return;
    for (const part of [old.root, old.leader]) {
      part?.traverse((child) => {
        if (!(child instanceof THREE.Mesh)) return;
        child.geometry.dispose();
        (child.material as THREE.Material).dispose();
      });
      if (part !== null) this.group.remove(part);
    }
    this.shown.delete(name);
  }

  /** Shows the tools at their poses. */
  show(poses: readonly ToolPose[], participants: readonly Participant[], own: number | null): void {
    const seen = new Set<string>();
    for (const pose of poses) {
      if (!pose.is_active) continue;
      const style: Style = pose.is_device ? "device" : pose.is_proxy ? "proxy" : "shared";
      const owner = participants.find((p) => p.id === pose.participant);
      const tool = owner?.tool ?? usual("ball");
      const name = `${pose.participant} ${style}`;
      const key = JSON.stringify(tool);
      if (this.shown.get(name)?.key !== key) {
        this.remove(name);
        this.shown.set(name, this.make(pose.participant, style, tool, key));
      }
      const shown = this.shown.get(name)!;
      shown.root.position.set(...pose.position);
      shown.root.quaternion.set(...pose.rotation);
      for (const jaw of shown.jaws) jaw.mesh.visible = jaw.isHeld === ((pose.buttons & 1) !== 0);
      seen.add(name);
      if (style === "device") continue;
      if (style === "proxy") {
        const device = poses.find((p) => p.is_device && p.participant === pose.participant);
        lead(shown.leader!, new THREE.Vector3(...(device ?? pose).position), shown.root.position);
        this.labels.put(`tool ${name}`, "name", "Proxy", ownerColour(pose.participant), shown.root.position, 14, 12);
        continue;
      }
      const top = new THREE.Vector3(0, 0, extent_m(tool) + HANDLE_LENGTH_M).applyQuaternion(shown.root.quaternion).add(shown.root.position);
      const label = pose.participant === own ? `${owner?.name ?? "You"} (you)` : (owner?.name ?? `Participant ${pose.participant}`);
      this.labels.put(`tool ${name}`, "name", label, ownerColour(pose.participant), top, 8, -10);
    }
    for (const name of [...this.shown.keys()]) if (!seen.has(name)) this.remove(name);
  }
}
