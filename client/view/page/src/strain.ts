// Colours of strains.

/** The strain from which the colour stays the same. */
export const STRAIN_MAX = 0.25;
type Rgb = [number, number, number];
const COMPRESSED: Rgb = [24, 78, 214];
const REST: Rgb = [150, 150, 150];
const STRETCHED: Rgb = [214, 30, 30];
/** Colours from `-STRAIN_MAX` to `STRAIN_MAX`. */
const TABLE: Rgb[] = Array.from({ length: 129 }, (_, i) => {
  const share = i / 64 - 1;
  const end = share < 0 ? COMPRESSED : STRETCHED;
  return REST.map((c, k) => Math.round(c + Math.abs(share) * (end[k] - c))) as Rgb;
});

/** The same as linear light, which vertex colours are. */
const LIGHT: Rgb[] = TABLE.map((rgb) => rgb.map((c) => Math.round(255 * linear(c / 255))) as Rgb);

/** Linear light of a component of sRGB (IEC 61966-2-1), both 0 to 1. */
function linear(c: number): number {
  return c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
}

function row(strain: number): number {
  return Math.round(64 * (1 + Math.max(-1, Math.min(1, strain / STRAIN_MAX))));
}

/** Red, green and blue of a strain in sRGB, 0 to 255: blue compressed, grey at rest, red stretched. */
export function strainColour(strain: number): Rgb {
  return TABLE[row(strain)];
}

/** The same as linear light, 0 to 255. */
export function strainLight(strain: number): Rgb {
  return LIGHT[row(strain)];
}

/** The colours of the legend as a background of CSS. */
export function strainGradient(): string {
  return `linear-gradient(to right, ${[COMPRESSED, REST, STRETCHED].map((c) => `rgb(${c.join(" ")})`).join(", ")})`;
}
