// The bar that shows the scale at the distance of the camera's target, in mm.
import { at, setText } from "./element.ts";
import type { OrbitCamera } from "./camera.ts";

const WIDEST_PX = 130;

export function showScale(orbit: OrbitCamera, height: number): void {
  const bar = at("scale");
  const mmPerPixel = 1000 * orbit.inPlane(1, 0, orbit.distance_m, height).length();
  if (!(mmPerPixel > 0)) return;
  const most = WIDEST_PX * mmPerPixel;
  const power = 10 ** Math.floor(Math.log10(most));
  const length = (most >= 5 * power ? 5 : most >= 2 * power ? 2 : 1) * power;
  bar.style.width = `${Math.round(length / mmPerPixel)}px`;
  setText(bar, `${+length.toPrecision(3)} mm`);
}
