// The renderer and the light. Software renderers get one pixel per pixel of the page and no antialiasing.
import * as THREE from "three";
import { Theme } from "./theme.ts";

/** The name of the graphics device; null without WebGL2. */
function device(): string | null {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (gl === null) return null;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(info === null ? gl.RENDERER : info.UNMASKED_RENDERER_WEBGL));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return name;
}

export class Scene {
  readonly scene = new THREE.Scene();
  readonly isSoftware: boolean;
  private readonly renderer: THREE.WebGLRenderer;
  private readonly key = new THREE.DirectionalLight(0xfffaf2, 2.3);

  private constructor(
    private readonly canvas: HTMLCanvasElement,
    name: string,
  ) {
    this.isSoftware = /swiftshader|llvmpipe|software|basic render/i.test(name);
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !this.isSoftware, powerPreference: "high-performance" });
    this.renderer.localClippingEnabled = true;
    this.renderer.setPixelRatio(this.isSoftware ? 1 : Math.min(2, devicePixelRatio));
    const sky = new THREE.HemisphereLight(0xf6f9ff, 0xa89c90, 1.7);
    sky.position.set(0, 0, 1);
    this.scene.add(sky, this.key, this.key.target);
    this.recolour();
  }

  /** Null if the browser has no WebGL2. */
  static create(canvas: HTMLCanvasElement): Scene | null {
    const name = device();
    return name === null ? null : new Scene(canvas, name);
  }

  recolour(): void {
    this.renderer.setClearColor(Theme.colour("--stage"));
  }

  /** Fits the picture to its element; returns whether the size changed. */
  resize(): boolean {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const size = this.renderer.getSize(new THREE.Vector2());
    if (width === 0 || (size.x === width && size.y === height)) return false;
    this.renderer.setSize(width, height, false);
    return true;
  }

  draw(camera: THREE.PerspectiveCamera): void {
    // The light comes from above the viewer's left shoulder.
    const e = camera.matrixWorld.elements;
    this.key.target.position.set(0, 0, 0);
    this.key.position
      .set(e[8], e[9], e[10])
      .addScaledVector(new THREE.Vector3(e[0], e[1], e[2]), -0.35)
      .addScaledVector(new THREE.Vector3(e[4], e[5], e[6]), 0.45);
    this.renderer.render(this.scene, camera);
  }
}
