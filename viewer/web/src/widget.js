// The page in a notebook cell, by anywidget. Strengths and camera are synchronized both ways, see viewer/widget.py.

import { show } from "./main.js";

const NAMES = ["strengths", "hidden", "blend", "camera"];
const alike = (a, b) => JSON.stringify(a) === JSON.stringify(b);

export async function render({ model, el }, shaders) {
  const { buffer, byteOffset, byteLength } = model.get("scene"), host = document.createElement("div");
  const shadow = host.attachShadow({ mode: "open" }), size = () => host.style.setProperty("height", `${model.get("height")}px`);
  shadow.innerHTML = model.get("_markup");
  el.append(host);
  size();
  model.on("change:height", size);
  host.addEventListener("keydown", (event) => {  // keys for a slider must not reach the notebook's cells
    const { ctrlKey, metaKey, altKey, shiftKey, key } = event;
    if (!(ctrlKey || metaKey || altKey || key === "Escape" || (shiftKey && key === "Enter"))) event.stopPropagation();
  });
  const page = await show(shadow.querySelector(".page"), new Uint8Array(buffer, byteOffset, byteLength), shaders);
  if (!page) return;
  const state = () => {
    const { layers, blend } = page.view, hidden = layers.filter((l) => !l.enabled).map((l) => l.name);
    return { blend, hidden, camera: page.camera, strengths: Object.fromEntries(layers.map((l) => [l.name, l.strength])) };
  };
  const take = (name) => {  // one at a time, as others may not have been sent yet
    const given = model.get(name), { view } = page;
    const change = (part) => page.change({ ...view, layers: view.layers.map((l) => ({ ...l, ...part(l) })) });
    if (alike(given, state()[name])) return;
    if (name === "camera") page.look({ ...page.camera, ...given });
    else if (name === "blend") page.change({ ...view, blend: given });
    else if (name === "hidden") change((l) => ({ enabled: !given?.includes(l.name) }));
    else change((l) => ({ strength: Number.isFinite(given?.[l.name]) ? given[l.name] : l.strength }));
  };
  page.shown = () => {  // called once per frame
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
