// The page in a cell of a notebook, by anywidget: strengths and camera go both ways, see viewer/widget.py.

import { show } from "./main.js";

const NAMES = ["strengths", "hidden", "blend", "camera"];
const alike = (a, b) => JSON.stringify(a) === JSON.stringify(b);

export async function render({ model, el }, shaders) {
  const host = document.createElement("div"), shadow = host.attachShadow({ mode: "open" }), bytes = model.get("scene");
  const size = () => host.style.setProperty("height", `${model.get("height")}px`);
  shadow.innerHTML = model.get("_markup");
  el.append(host);
  size();
  model.on("change:height", size);
  host.addEventListener("keydown", (event) => {  // no key that is meant for a slider acts on the notebook's cells
    const { ctrlKey, metaKey, altKey, shiftKey, key } = event;
    if (!(ctrlKey || metaKey || altKey || key === "Escape" || (shiftKey && key === "Enter"))) event.stopPropagation();
  });
  const numbers = new Uint8Array(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const page = await show(shadow.querySelector(".page"), numbers, shaders);
  if (!page) return;
  const state = () => {
    const { layers, blend } = page.view, hidden = layers.filter((l) => !l.enabled).map((l) => l.name);
    return { blend, hidden, camera: page.camera, strengths: Object.fromEntries(layers.map((l) => [l.name, l.strength])) };
  };
  const take = (name) => {  // one at a time, as the others may be on their way out
    const given = model.get(name), { view } = page;
    const change = (part) => page.change({ ...view, layers: view.layers.map((l) => ({ ...l, ...part(l.name) })) });
    if (alike(given, state()[name])) return;
    if (name === "camera") page.look(given);
    else if (name === "blend") page.change({ ...view, blend: given });
    else change(name === "hidden" ? (l) => ({ enabled: !given.includes(l) }) : (l) => ({ strength: given[l] }));
  };
  page.shown = () => {  // once a frame
    const now = state(), changed = NAMES.filter((name) => !alike(now[name], model.get(name)));
    for (const name of changed) model.set(name, now[name]);
    if (changed.length) model.save_changes();
  };
  for (const name of NAMES) {
    model.on(`change:${name}`, () => take(name));
    take(name);
  }
  return () => page.close();
}
