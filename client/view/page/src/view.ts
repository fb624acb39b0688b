// The view of a session: takes the messages of the host, keeps their state, and draws it.
import * as THREE from "three";
import { AnnotationView } from "./annotations.ts";
import { OrbitCamera } from "./camera.ts";
import { Connection, type FromWorker } from "./connection.ts";
import { Console } from "./console.ts";
import { at, setText } from "./element.ts";
import { Figures, clock } from "./figures.ts";
import { ForceView } from "./forces.ts";
import { type Invitation, hello, invitation, keepSeat, takeSeat } from "./invitation.ts";
import { listen } from "./keys.ts";
import { Labels } from "./labels.ts";
import { Layers } from "./layers.ts";
import type { Act, HostBinary, HostText, Pong, State, Surface, ToolPose, Welcome } from "./messages.ts";
import { Meter } from "./meter.ts";
import { Palette } from "./palette.ts";
import { People } from "./people.ts";
import { Playout, withReaction } from "./playout.ts";
import { Plots } from "./plots.ts";
import { Pointer } from "./pointer.ts";
import { publish } from "./probe.ts";
import { ask } from "./question.ts";
import { showScale } from "./scale.ts";
import type { Scene } from "./scene.ts";
import { SpringView } from "./springs.ts";
import { Status } from "./status.ts";
import { StrokeView } from "./stroke.ts";
import { Theme } from "./theme.ts";
import { Tissue } from "./tissue.ts";
import { ToolView } from "./tools.ts";

/** A hidden page draws no pictures; it takes up shapes at this interval, ms. */
const HIDDEN_MS = 250;
/** Distance of a new tool from the tissue, and between new tools, m. */
const APART_M = 0.02;
/** Depth by one press of a button of the palette, m. */
const DEPTH_M = 0.002;
/** The page catches up if an update lacks for so long; a cut shows up to D late anyway, ms. */
const LATE_MS = 1500;
/** A surface without a shape is displayed after this time, ms. */
const PATIENCE_MS = 1000;
/** Time between two figures of springs, ms. */
const FIGURES_MS = 500;

export class View {
  readonly status = new Status();
  readonly meter = new Meter();
  readonly orbit = new OrbitCamera();
  readonly playout = new Playout();
  readonly tissue: Tissue;
  readonly springs: SpringView;
  readonly pointer: Pointer;
  readonly connection: Connection;
  private readonly labels = new Labels(at("labels"), this.orbit.camera);
  private readonly tools: ToolView;
  private readonly forces = new ForceView(this.labels);
  private readonly strokes = new StrokeView();
  private readonly annotations = new AnnotationView(this.labels);
  private readonly figures = new Figures();
  private readonly plots = new Plots();
  private readonly palette: Palette;
  private readonly layers: Layers;
  private readonly console: Console;
  private readonly people: People;
  private readonly surfaces = new Map<number, Surface>();
  private invited: Invitation = invitation(location.hash);
  welcome: Welcome | null = null;
  state: State | null = null;
  /** Tools at the displayed time. */
  poses: ToolPose[] = [];
  private camera: number | null = null;
  private size_m = 0.2;
  private stepped_ms = 0;
  private figured_ms = 0;
  private shown_s: number | null = null;
  private behind_ms: number | null = null;
  private isDirty = true;

  constructor(private readonly scene: Scene) {
    this.tissue = new Tissue(scene.isSoftware);
    this.springs = new SpringView(this.tissue);
    this.tools = new ToolView(this.labels, scene.isSoftware);
    this.connection = new Connection((message) => this.take(message));
    const send = (act: Act): void => this.control(act);
    this.pointer = new Pointer(at("picture"), this.orbit, () => this.connection.serverTime_us(), (samples) => this.connection.move(samples));
    this.palette = new Palette(
      (tool) => this.connection.send({ type: "tool", tool }),
      (isHeld) => this.pointer.holdButton(isHeld),
      (movesTool) => this.setMode(movesTool),
      (steps) => this.pointer.deepen(steps * DEPTH_M),
    );
    this.layers = new Layers(
      () => ((this.isDirty = true), this.tissue.show()),
      (plane) => ((this.isDirty = true), this.tissue.setClip(plane), this.springs.setClip(plane)),
      (isShown) => (this.forces.isShown = isShown),
      (region) => this.showSprings(region),
    );
    this.console = new Console(send, () => this.showCamera(), () => this.showMode(), () => this.connection.serverTime_us());
    this.people = new People(send, () => this.plots.clear());
    scene.scene.add(this.tissue.group, this.springs.group, this.tools.group, this.forces.group, this.strokes.group, this.annotations.group);
    new Theme(() => {
      scene.recolour();
      this.isDirty = true;
    });
  }

  /** Shows the springs of a region, or none. */
  showSprings(region: number | null): void {
    this.springs.region = region;
    this.springs.display();
    this.isDirty = true;
    // The host keeps the choice and sends the springs of each topology once.
    this.connection.send({ type: "springs", region });
  }

  control(act: Act): void {
    this.connection.send({ type: "control", ...act });
  }

  start(): void {
    listen({
      orbit: this.orbit,
      palette: this.palette,
      canUseTools: () => this.pointer.canSteer,
      switchMode: () => this.setMode(!this.pointer.movesTool),
      cancel: () => this.console.setPlacing(null),
    });
    this.pointer.onHeld = () => this.showMode();
    this.pointer.onClick = (ray) => this.annotate(ray);
    window.addEventListener("pagehide", () => keepSeat(this.welcome?.seat ?? null));
    setInterval(() => {
      if (performance.now() - this.stepped_ms > HIDDEN_MS) this.step(performance.now());
    }, HIDDEN_MS);
    at("leave").addEventListener("click", () => void this.leave());
    publish(this);
    requestAnimationFrame(() => this.picture());
    const form = at("name-form") as HTMLFormElement;
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.invited.name = (at("name-field") as HTMLInputElement).value.trim();
      if (this.invited.name !== "") this.join();
    });
    if (this.invited.role !== null && this.invited.name === "") {
      this.status.set({ kind: "asking" });
      at("name-field").focus();
    } else {
      this.join();
    }
  }

  private async leave(): Promise<void> {
    if (await ask("Leave the session and give your seat up?", "Leave")) this.connection.send({ type: "leave" });
  }

  private join(): void {
    this.status.set({ kind: "connecting", seconds_left: null, sentence: null });
    this.connection.open(hello(this.invited, this.palette.tool), takeSeat());
  }

  private take(message: FromWorker): void {
    switch (message.kind) {
      case "text":
        return this.takeText(message.message);
      case "binary":
        return this.takeBinary(message.message, message.arrived_ms - performance.timeOrigin);
      case "retrying": {
        this.pointer.canSteer = false;
        const { seconds_left, sentence } = message;
        return this.status.set({ kind: message.was_joined ? "lost" : "connecting", seconds_left, sentence });
      }
      case "refused":
      case "ended":
        this.pointer.canSteer = false;
        this.welcome = null;
        at("leave").hidden = true;
        return this.status.set({ kind: message.kind, sentence: message.sentence });
      case "clock":
      case "transport":
        return undefined;
    }
  }

  private takeText(message: Exclude<HostText, Pong>): void {
    if (message.type === "welcome") {
      // An instructor begins by looking, and takes the tool up by a switch.
      if (this.welcome === null) this.pointer.movesTool = message.role !== "instructor";
      this.welcome = message;
      this.playout.reset();
      this.playout.lag = message.source === "replica" ? 0.125 : 1;
      this.pointer.unplace();
      this.tissue.setRegions(message.regions);
      this.layers.setRegions(message.regions, this.tissue.layers);
      this.springs.forget();
      if (this.springs.region !== null) this.connection.send({ type: "springs", region: this.springs.region });
      this.people.isInstructor = message.role === "instructor";
      at("console").hidden = at("settings").hidden = message.role !== "instructor";
      at("palette").hidden = !message.can_steer;
      at("leave").hidden = message.source !== "server";
      this.status.set({ kind: this.tissue.surface === null ? "downloading" : "joined" });
      this.showConditions();
    } else if (message.type === "state") {
      this.takeState(message);
    } else if (message.type === "notice") {
      this.status.notice(message.sentence);
    } else if (message.type === "invitation") {
      this.console.invitations.showNewest(message);
    }
  }

  private takeState(state: State): void {
    this.state = state;
    const own = this.welcome?.participant ?? null;
    this.people.show(state.participants, own);
    this.console.show(state);
    setText(at("clock"), clock(state.session.clock_s));
    const tool = state.participants.find((p) => p.id === own)?.tool;
    if (tool !== undefined && tool !== null) this.palette.adopt(tool);
    if (state.camera !== null && state.camera.id !== this.camera && this.tissue.surface !== null) {
      this.camera = state.camera.id;
      this.orbit.show(state.camera.position_m, state.camera.target_m, state.camera.up);
    }
    this.showFigures();
    this.showConditions();
    this.isDirty = true;
  }

  private showFigures(): void {
    if (this.state === null) return;
    this.figures.show(this.state, this.welcome?.participant ?? null, {
      fps: this.meter.fps,
      rtt_ms: this.connection.rtt_ms,
      transport: this.connection.transport,
      latency_ms: this.meter.latency_ms?.median ?? null,
      delay_ms: this.playout.delay_ms,
      force_n: this.force(this.welcome?.participant ?? null),
    });
  }

  private showConditions(): void {
    const self = this.state?.participants.find((p) => p.id === this.welcome?.participant);
    const isBehind = this.tissue.surface !== null && (this.playout.isWaiting || this.tissue.surface.version !== this.state?.session.topology_version);
    this.behind_ms = isBehind ? (this.behind_ms ?? performance.now()) : null;
    const isLate = this.behind_ms !== null && performance.now() - this.behind_ms > LATE_MS;
    const isDemoted = self?.is_demoted ?? false;
    this.status.setConditions({
      isCatchingUp: this.state !== null && isLate,
      isDemoted,
      isMuted: self?.is_muted ?? false,
      isFrozen: this.state?.session.is_frozen ?? false,
    });
    this.pointer.canSteer = this.welcome?.can_steer === true && !isDemoted && ["joined", "downloading"].includes(this.status.phase.kind);
    this.showMode();
  }

  private takeBinary(message: HostBinary, arrived_ms: number): void {
    if (message.kind === "tools") {
      this.playout.addTools(message, arrived_ms);
    } else if (message.kind === "shape") {
      this.playout.addShape(message, arrived_ms);
    } else if (message.kind === "springs") {
      this.springs.add(message);
      this.isDirty = true;
    } else {
      this.surfaces.set(message.version, message);
      const shown = this.playout.addSurface(message.version, message.numbers.length);
      if (shown !== null) this.display(shown);
      else if (this.isReplaced(message)) this.redisplay(message.version);
      else setTimeout(() => this.impatient(message.version), PATIENCE_MS);
      if (this.status.phase.kind === "downloading") this.status.set({ kind: "joined" });
      this.showConditions();
    }
  }

  /** Whether a surface takes the place of the displayed one with the same version, as after a restart of the server. */
  private isReplaced({ version, hash, numbers }: Surface): boolean {
    const shown = this.tissue.surface;
    return shown?.version === version && (shown.hash !== hash || shown.numbers.length !== numbers.length);
  }

  /** Displays the newest surface at rest if no shape of it has come. */
  private impatient(version: number): void {
    if (!this.surfaces.has(version) || this.playout.hasShapeOf(version)) return;
    if (this.state?.session.topology_version === version && this.tissue.surface?.version !== version) this.redisplay(version);
  }

  private redisplay(version: number): void {
    this.playout.display(version);
    this.display(version);
  }

  /** Displays the surface of a version and forgets older ones. */
  private display(version: number): void {
    const surface = this.surfaces.get(version);
    if (surface === undefined) return;
    const isFirst = this.tissue.surface === null;
    this.tissue.setSurface(surface);
    this.springs.display();
    for (const old of [...this.surfaces.keys()]) if (old < version) this.surfaces.delete(old);
    this.strokes.clearFinished();
    this.isDirty = true;
    if (!isFirst) return;
    const bounds = this.tissue.bounds();
    this.size_m = bounds.getSize(new THREE.Vector3()).length();
    this.forces.size_m = this.size_m;
    this.layers.setBounds(bounds);
    this.orbit.setBounds(bounds);
    this.fitAtStart();
  }

  private fitAtStart(): void {
    this.scene.resize();
    this.orbit.resize(at("picture").clientWidth, at("picture").clientHeight);
    this.orbit.fit(true);
    this.orbit.update(performance.now());
  }

  /** Advances the displayed shape. */
  private step(now_ms: number): void {
    this.stepped_ms = now_ms;
    const step = this.playout.advance(now_ms);
    if (step.version !== null) this.display(step.version);
    if (step.isAll || step.nodes.length > 0) {
      const moved = step.isAll ? null : step.nodes;
      this.tissue.update(this.playout.shown, moved);
      this.springs.update(moved);
      this.isDirty = true;
    }
    for (const solved_ms of step.solved_ms) this.meter.drawn(solved_ms, now_ms);
    const poses = this.playout.tools().map((pose) => withReaction(pose, this.playout.reactions));
    if (this.playout.time_s !== this.shown_s || this.pointer.isMovingTool) this.isDirty = true;
    this.shown_s = this.playout.time_s;
    this.poses = poses;
  }

  private picture(): void {
    requestAnimationFrame(() => this.picture());
    const now_ms = performance.now();
    this.meter.picture(now_ms);
    this.step(now_ms);
    this.placeTool();
    if (this.scene.resize()) this.orbit.resize(at("picture").clientWidth, at("picture").clientHeight);
    this.orbit.update(now_ms);
    if (now_ms - this.figured_ms > FIGURES_MS) {
      this.figured_ms = now_ms;
      this.layers.showSprings(this.springs.figures());
    }
    if (this.plots.isDue(now_ms) && this.welcome !== null) this.plot(now_ms);
    if (!this.isDirty && !this.orbit.hasMoved) return;
    if (this.orbit.hasMoved) showScale(this.orbit, at("picture").clientHeight);
    this.isDirty = this.orbit.hasMoved = false;
    const people = this.state?.participants ?? [];
    const own = this.welcome?.participant ?? null;
    this.labels.begin();
    this.tools.show([...this.poses, ...this.pointer.ghost(own, this.poses)], people, own);
    this.forces.show(this.poses, people, this.playout.reactions);
    this.strokes.show(this.poses, people, now_ms);
    this.annotations.show(this.state?.annotations ?? [], this.tissue, this.size_m);
    this.labels.end();
    this.scene.draw(this.orbit.camera);
    if (this.tissue.surface !== null) this.meter.first_picture_ms ??= now_ms;
  }

  private plot(now_ms: number): void {
    const selected = this.people.selected;
    const name = this.state?.participants.find((p) => p.id === selected)?.name ?? "the tool";
    this.plots.add(name, this.force(selected) ?? 0, this.playout.delay_ms ?? this.state?.session.delay_ms ?? 0, now_ms);
  }

  /** Size of the force on the tool of a participant, N; null without one. */
  force(participant: number | null): number | null {
    const pose =
      this.poses.find((p) => p.participant === participant && p.is_proxy) ??
      this.poses.find((p) => p.participant === participant && p.is_active && !p.is_device);
    return pose === undefined ? null : Math.hypot(...pose.force);
  }

  /** Takes the place of the own tool from the host, or starts above the middle of the picture. */
  private placeTool(): void {
    const own = this.welcome?.participant;
    if (!this.pointer.isMovingTool || this.pointer.isPlaced || own === undefined || this.tissue.surface === null) return;
    const known = this.poses.find((pose) => pose.participant === own && pose.is_active);
    if (known !== undefined) {
      this.pointer.place(...known.position);
      return;
    }
    if (this.playout.time_s === null) return;
    const ray = new THREE.Ray(this.orbit.camera.position.clone(), this.orbit.forward);
    const hit = this.tissue.pick(ray);
    const start = hit === null ? this.orbit.target.clone() : new THREE.Vector3(...hit.point).addScaledVector(new THREE.Vector3(...hit.normal), APART_M);
    const side = ((own % 4) - 1.5) * APART_M;
    const e = this.orbit.camera.matrixWorld.elements;
    this.pointer.place(start.x + side * e[0], start.y + side * e[1], start.z + side * e[2]);
  }

  private annotate(ray: THREE.Ray): boolean {
    const placing = this.console.placing;
    if (placing === null) return false;
    const hit = this.tissue.pick(ray);
    if (hit === null) {
      this.status.notice("Click a point of the tissue to place the annotation.");
      return true;
    }
    const { nodes, weights, normal } = hit;
    const offset_m = new THREE.Vector3(...normal).multiplyScalar(0.12 * this.size_m).toArray();
    this.control({ act: "annotate", ...placing, nodes, weights, offset_m });
    this.console.setPlacing(null);
    return true;
  }

  private showCamera(): void {
    const { camera, target } = this.orbit;
    this.control({
      act: "show_camera",
      position_m: camera.position.toArray(),
      target_m: target.toArray(),
      up: this.orbit.up.toArray(),
    });
  }

  private setMode(movesTool: boolean): void {
    this.pointer.movesTool = movesTool;
    this.showMode();
  }

  private showMode(): void {
    at("picture").dataset.mode = this.console?.placing ? "place" : this.pointer.isMovingTool ? "tool" : "view";
    this.palette.showMode(this.pointer.isHeld, this.pointer.movesTool);
  }
}
