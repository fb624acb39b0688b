// The page: puts its parts together, takes the messages of the host, and draws pictures.
import { View } from "./view.ts";
import { Status } from "./status.ts";
import { Scene } from "./scene.ts";
import { at } from "./element.ts";

const scene = Scene.create(at("picture") as HTMLCanvasElement);
if (scene === null) {
  new Status().set({ kind: "unsupported", sentence: "It needs WebGL2; use a current browser with graphics acceleration switched on." });
} else {
  new View(scene).start();
}
