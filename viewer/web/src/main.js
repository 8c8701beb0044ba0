// A page in its root element: redraws whenever the view or the camera changes.

import { addScaled, pinhole, pivotOn } from "./camera.js";
import { Composer } from "./compose.js";
import { Container } from "./data.js";
import { listen } from "./input.js";
import { buildPanel } from "./panel.js";
import { Renderer, depthRow } from "./renderer.js";
import { Sorter } from "./sort.js";
import { mixCameras, restore, stateAt, visibleLayers } from "./state.js";

const MOST_PIXELS = 4e6;
const SLOW_MS = 45;  // slower frames in motion are drawn with fewer pixels
const SHARES = [1, 0.5, 0.25, 0.125];  // of the width and height, in motion
const FIRST_SHARE = 0.25;  // of the first picture, when the speed of the device is unknown
const POLL_MS = 8, REST_MS = 180, GLIDE_MS = 250;

class Page {
  get = (id) => this.root.querySelector(`#${id}`);
  gone = new AbortController();

  constructor(root, container, shaders) {
    const { header } = container;
    this.root = root;
    this.header = header;
    this.canvas = this.get("picture");
    this.renderer = new Renderer(this.canvas, shaders, container);
    this.composer = new Composer(container);
    this.means = new Float32Array(3 * header.count);
    container.attribute("means", 0, header.count, this.means, 3);
    this.paints = header.paints.map(container.real, container);  // a closure would keep the container in memory
    this.sorter = new Sorter(this.means, header.near, (order, seen) => {
      this.renderer.setOrder(order, seen);
      if (!this.sorting) this.request();
    });
    this.view = { layers: header.layers, groups: header.groups, blend: header.blend };
    this.home = this.camera = header.camera;
    this.radius = header.radius;
    const original = { name: "original", ...this.view, layers: header.layers.map((layer) => ({ ...layer, strength: 0 })) };
    this.snapshots = [original, ...header.snapshots];
    Object.assign(this, { frame: 0, playing: false, comparing: false });
    this.times = {};  // of the last frame with all pixels (sharp) and with fewer (coarse), ms
    this.update = buildPanel(this.get("controls"), this);
    this.#bind();
    const touch = matchMedia("(pointer: coarse)").matches, zoom = this.takesWheel ? "scroll to zoom" : "click, then scroll to zoom";
    this.get("notice").textContent = touch
      ? "Drag to turn · pinch to zoom · tap twice to center" : `Drag to turn · ${zoom} · Space compares`;
    root.classList.add("ready");
    this.resize();
    this.change(this.view);
    this.movedAt = 0;  // nothing has moved yet
  }

  // Sets another view.
  change(view, chosen = null) {
    this.view = view;
    this.chosen = chosen;  // index of the snapshot on screen, null after a change
    this.dirty = true;
    this.movedAt = performance.now();
    this.update();
    this.request();
  }

  look(camera) {
    if (camera === this.camera) return;
    this.camera = camera;
    this.movedAt = performance.now();
    this.turned = true;
    this.request();
  }

  touched() {
    this.playing = false;
    this.glide = null;
    this.root.classList.add("touched");
  }

  choose(index) {
    this.#film(false);
    this.change(restore(this.view, this.snapshots[index]), index);
    if (this.snapshots[index].camera) this.glideTo(this.snapshots[index].camera);
  }

  play = () => this.#film(!this.playing);

  seek(frame) {
    const { view, camera } = stateAt(this.header.timeline, frame, this.view, this.camera);
    this.frame = frame;
    this.look(camera);
    this.change(view);
  }

  compare(on) {
    if (on === this.comparing) return;
    this.comparing = on;
    this.get("compare").setAttribute("aria-pressed", on);
    this.movedAt = performance.now();
    this.dirty = true;
    this.request();
  }

  glideTo(camera) {
    this.glide = { from: this.camera, to: camera, start: performance.now() };
    this.request();
  }

  pivotAt(x, y) {
    const at = this.#pinhole(), scale = this.canvas.width / this.canvas.clientWidth, [fx, fy, cx, cy] = at.intrinsics;
    const depth = this.renderer.depthAt(at, x * scale, y * scale);
    if (depth === null) return;
    const way = [(x * scale - cx) / fx, (y * scale - cy) / fy, 1];
    const point = addScaled(at.eye, ...at.rows.map((axis, i) => [depth * way[i], axis]));
    this.glideTo(pivotOn(this.camera, point, this.radius));
  }

  get focal() {
    return this.#pinhole().intrinsics[0] * (this.canvas.clientWidth / this.canvas.width);
  }

  // In a notebook the wheel scrolls the notebook until the user clicks the page.
  get takesWheel() {
    return this.root === document.body || this.root.matches(":focus-within");
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = Math.min(devicePixelRatio || 1, Math.sqrt(MOST_PIXELS / Math.max(width * height, 1)));
    this.canvas.width = Math.max(1, Math.round(width * ratio));
    this.canvas.height = Math.max(1, Math.round(height * ratio));
    const [right, bottom] = this.#free();  // the still lies where the picture will be drawn
    this.get("still").style = `left: ${right / 2}px; top: ${bottom / 2}px; --side: ${Math.min(right, bottom)}px`;
    this.request();
  }

  request() {
    this.root.classList.remove("sharp");
    this.pending ??= requestAnimationFrame((now) => this.#draw(now));
  }

  // Returns the picture as a data URL of a PNG.
  picture() {
    this.#draw(performance.now(), 1);
    return this.canvas.toDataURL();
  }

  #film(playing) {
    this.playing = playing;
    this.lastFrame = null;
    this.glide = null;
    this.update();
    this.request();
  }

  // Returns the width and height of the free area beside the panel, CSS pixels. The picture is centered on it.
  #free() {
    const { clientWidth: width, clientHeight: height } = this.canvas, panel = this.get("panel");
    if (this.root.classList.contains("folded")) return [width, height];
    const beside = panel.offsetWidth < 0.7 * width, free = beside ? [panel.offsetLeft, height] : [width, panel.offsetTop];
    return Math.min(...free) < 40 ? [width, height] : free;
  }

  #pinhole() {
    const { width, height, clientWidth } = this.canvas, scale = width / Math.max(clientWidth, 1);
    return pinhole(this.camera, width, height, this.#free().map((side) => Math.round(side * scale)));
  }

  // Draws a frame, at a share of its width and height that the device draws in time if none is given.
  #draw(now, share = null) {
    if (share === null) this.pending = null;
    // hidden, for example while a notebook changes its theme: its size may be the same afterwards
    if (!this.canvas.clientWidth) return void (this.resting = setTimeout(() => this.request(), REST_MS));
    if ((this.again = share === null && this.drawing)) return this.shown?.();  // the picture is late, not the values
    this.#advance(now);
    if (this.dirty) this.#compose();
    const at = this.#pinhole(), row = depthRow(at);
    if (this.turned || this.sorted?.some((x, i) => x !== row[i]) !== false) {
      Object.assign(this, { sorted: row, turned: false, sorting: true });
      this.sorter.sort(row);
      this.sorting = false;
    }
    if (this.renderer.drawn === null) return;  // not sorted yet
    const moving = this.movedAt > now - REST_MS;
    if (moving) {
      clearTimeout(this.resting);
      this.resting = setTimeout(() => this.request(), REST_MS + 20);
    }
    const drawn = share ?? this.#share(moving);
    this.renderer.draw(at, this.header.background, drawn);
    if (share === null) this.#watch(drawn);
    this.shown?.();
  }

  // Returns the share of the width and height at which a frame in motion takes about SLOW_MS.
  #share(moving) {
    const { sharp, coarse } = this.times;
    if (sharp === undefined && !coarse) return FIRST_SHARE;
    if (!moving || coarse > sharp / 2) return 1;  // then fewer pixels do not help
    return SHARES.find((share) => share ** 2 * sharp <= SLOW_MS) ?? SHARES.at(-1);
  }

  // Waits until a frame is finished, and notes its time.
  async #watch(share) {
    const { gl } = this.renderer, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0), start = performance.now();
    this.drawing = true;
    gl.flush();
    do {
      await new Promise((done) => setTimeout(done, POLL_MS));
      if (this.gone.signal.aborted || gl.isContextLost()) return;
    } while (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED);
    gl.deleteSync(fence);
    this.drawing = false;
    if (this.times.sharp === undefined) performance.mark(share === 1 ? "sharp picture" : "first picture");
    this.times[share === 1 ? "sharp" : "coarse"] = performance.now() - start;
    if (share === 1 || this.movedAt) this.root.classList.add("drawn");  // the still is sharp until then
    if (this.again || this.times.sharp === undefined) this.request();
    else if (share === 1 && !this.pending) this.root.classList.add("sharp");  // until the next change
  }

  #advance(now) {
    if (this.glide) {
      const { from, to, start } = this.glide, share = Math.min((now - start) / GLIDE_MS, 1);
      this.look(mixCameras(from, to, share * share * (3 - 2 * share)));
      if (share >= 1) this.glide = null;
      this.request();
    }
    if (!this.playing) return;
    const { frames, fps, ping_pong: back } = this.header.timeline, last = frames.length - 1;
    const round = back ? 2 * last : last + 1, passed = now - (this.lastFrame ?? now);
    this.clock = ((this.lastFrame === null ? this.frame : this.clock) + (passed * fps) / 1000) % round;
    this.lastFrame = now;
    this.seek(this.clock <= last ? this.clock : back ? round - this.clock : last);
    this.request();
  }

  #compose() {
    this.dirty = false;
    const layers = this.comparing ? [] : visibleLayers(this.view);
    for (const layer of layers) layer.weights = this.paints[layer.paint] ?? null;
    const changed = this.composer.update(layers, this.view.blend);
    if (!changed) return;
    this.renderer.update(this.composer, changed);
    if (changed.names.includes("means")) {
      for (const [first, last] of changed.ranges) {
        this.means.set(this.composer.after.means.subarray(3 * first, 3 * last), 3 * first);
        this.sorter.moved(first, last);
      }
      this.turned = true;
    }
  }

  #bind() {
    const { root, get, canvas } = this, until = { signal: this.gone.signal };
    listen(canvas, this);
    this.sizes = new ResizeObserver(() => this.resize());
    this.sizes.observe(canvas);
    const press = (id, act) => get(id).addEventListener("click", act);
    press("fold", () => {
      const folded = root.classList.toggle("folded");
      get("fold").setAttribute("aria-expanded", !folded);
      this.request();
    });
    press("home", () => this.glideTo(this.home));
    press("full", () => (document.fullscreenElement ? document.exitFullscreen() : root.requestFullscreen?.()));
    const hold = get("compare");
    hold.addEventListener("pointerdown", () => this.compare(true));
    const release = () => this.compare(false);
    for (const name of ["pointerup", "pointerleave", "pointercancel", "blur"]) hold.addEventListener(name, release);
    root.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === " ") {
        event.preventDefault();
        this.compare(true);
      } else if (event.key === "p" && this.header.timeline) this.play();
      else if (event.key === "Home" && event.target.type !== "range") this.glideTo(this.home);
    });
    addEventListener("keyup", (event) => {
      if (event.key !== " " || !this.comparing) return;
      event.preventDefault();
      this.compare(false);
    }, until);
    addEventListener("blur", release, until);
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      root.classList.remove("drawn");
      get("notice").textContent = "The graphics card was reset; reload the page.";
    }, until);
  }

  // Releases all resources and stops drawing.
  close() {
    this.gone.abort();
    this.sizes.disconnect();
    clearTimeout(this.resting);
    cancelAnimationFrame(this.pending);
    this.sorter.worker?.terminate();
    this.renderer.release();
  }
}

// Shows the page of a container's bytes (or a promise of them) in `root`; returns null after showing an error.
export async function show(root, bytes, shaders) {
  try {
    return new Page(root, new Container(await bytes), shaders);
  } catch (error) {
    root.querySelector("#notice").textContent = error.message === "no WebGL2"
      ? "WebGL2 is off in this browser, so this is a still picture."
      : `The scene cannot be shown here: ${error.message}`;
    return null;
  }
}
