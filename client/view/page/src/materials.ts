// Colours of tissues by the name of their material, with a grain that makes them recognisable, and the darker, redder tone of
// their wounds.
import { Color } from "three";

interface Look {
  colour: string;
  /** Size of the grain, mm, and its contrast. */
  grain_mm: number;
  contrast: number;
  /** How much longer the grain is along z, as in muscle fibres. */
  stretch: number;
  /** Strength of highlights, 0 to 1. */
  gloss: number;
  /** Whether a wound of it bleeds. */
  bleeds: boolean;
}

function look(colour: string, grain_mm: number, contrast: number, gloss: number, bleeds = true, stretch = 1): Look {
  return { colour, grain_mm, contrast, stretch, gloss, bleeds };
}

const LOOKS: Record<string, Look> = {
  skin: look("#d8a183", 9, 0.05, 0.1),
  fat: look("#efd27a", 5, 0.14, 0.25),
  muscle: look("#a63c37", 3, 0.2, 0.25, true, 7),
  tendon: look("#e2dccb", 3, 0.1, 0.4, true, 7),
  fascia: look("#e3d3cc", 8, 0.08, 0.4),
  bone: look("#ece3c8", 6, 0.07, 0.1),
  cancellous: look("#d9ae86", 3, 0.2, 0.1),
  marrow: look("#93302d", 5, 0.15, 0.3),
  cartilage: look("#cbdde2", 10, 0.05, 0.5),
  vessel: look("#b51f2b", 8, 0.07, 0.5),
  liver: look("#74291f", 9, 0.1, 0.5),
  spleen: look("#5f2740", 9, 0.1, 0.4),
  kidney: look("#863a2f", 9, 0.08, 0.45),
  gallbladder: look("#5f8440", 10, 0.08, 0.5),
  lung: look("#dc9f9b", 4, 0.14, 0.15),
  foam: look("#e8c766", 2.5, 0.12, 0, false),
  rubber: look("#4a4d53", 10, 0.03, 0.2, false),
  abs: look("#d4d1c6", 10, 0.02, 0.2, false),
  pla: look("#4d90c4", 10, 0.02, 0.2, false),
  polycarbonate: look("#a5c5d6", 10, 0.02, 0.5, false),
};
const BLOOD = new Color("#7d1218");

/** The look of a material; an unknown one gets a quiet colour from its name. */
function lookOf(material: string): Look {
  const known = LOOKS[material.toLowerCase()];
  if (known !== undefined) return known;
  let hue = 0;
  for (const letter of material) hue = (hue * 31 + letter.charCodeAt(0)) % 360;
  return look(`hsl(${hue}, 32%, 62%)`, 8, 0.06, 0.2, false);
}

/** The colour of a material, as CSS. */
export function colourOf(material: string): string {
  return lookOf(material).colour;
}

export function glossOf(material: string): number {
  return lookOf(material).gloss;
}

function lattice(x: number, y: number, z: number): number {
  let h = (Math.imul(x, 374761393) + Math.imul(y, 668265263) + Math.imul(z, 1442695041)) | 0;
  h = Math.imul(h ^ (h >>> 13), 1274126177);
  return ((h ^ (h >>> 16)) >>> 0) / 4294967295;
}

/** Smooth noise of unit grain, 0 to 1. */
function noise(x: number, y: number, z: number): number {
  const [i, j, k] = [Math.floor(x), Math.floor(y), Math.floor(z)];
  const ease = (t: number): number => t * t * (3 - 2 * t);
  const [u, v, w] = [ease(x - i), ease(y - j), ease(z - k)];
  const mix = (a: number, b: number, t: number): number => a + t * (b - a);
  const edge = (dy: number, dz: number): number => mix(lattice(i, j + dy, k + dz), lattice(i + 1, j + dy, k + dz), u);
  return mix(mix(edge(0, 0), edge(1, 0), v), mix(edge(0, 1), edge(1, 1), v), w);
}

/** A place in the tissue: away from wounds, on the wall of a wound, or on its edge, which alone is seen of a closed wound. */
export type Place = "intact" | "wall" | "edge";

/** Colours points of a material in a linear space, by rest position in m. */
export class Pigment {
  private readonly tone: Color;
  private readonly look: Look;

  constructor(material: string, place: Place) {
    this.look = lookOf(material);
    this.tone = new Color(this.look.colour);
    if (place === "intact") return;
    this.tone.multiplyScalar(place === "wall" ? 0.68 : 0.4);
    if (this.look.bleeds) this.tone.lerp(BLOOD, place === "wall" ? 0.45 : 0.9);
  }

  /** Writes the colour at a rest position, as three bytes. */
  write(rest: Float32Array, node: number, into: Uint8Array, at: number): void {
    const { grain_mm, stretch, contrast } = this.look;
    const scale = 1000 / grain_mm;
    const [x, y, z] = [rest[3 * node] * scale, rest[3 * node + 1] * scale, (rest[3 * node + 2] * scale) / stretch];
    const grain = 0.65 * noise(x, y, z) + 0.35 * noise(2.3 * x + 7, 2.3 * y, 2.3 * z);
    const bright = 1 + 2 * contrast * (grain - 0.5);
    into[at] = Math.min(255, 255 * this.tone.r * bright);
    into[at + 1] = Math.min(255, 255 * this.tone.g * bright);
    into[at + 2] = Math.min(255, 255 * this.tone.b * bright);
  }
}
