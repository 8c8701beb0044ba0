// The panel: a row with a slider for each layer and group, snapshots, timeline. All texts are untrusted.

function make(kind, options = {}, ...children) {
  const element = document.createElement(kind);
  for (const [name, value] of Object.entries(options)) {
    if (name === "on") for (const [event, act] of Object.entries(value)) element.addEventListener(event, act);
    else if (name === "class") element.className = value;
    else if (name in element) element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.filter(Boolean));
  return element;
}

const RULES = { normalized: "Average", sum: "Add", over: "Over", adjust: "Adjust" };  // same names as in the window

const percent = (x) => `${Math.round(100 * x)}`;

// Creates a labeled range input 0..most; `ticks`: recorded strengths.
function slider(label, most, ticks, moved, step = 0.01) {
  const value = make("output");
  const input = make("input", { type: "range", min: 0, max: most, step, "aria-label": label });
  const marks = ticks.filter((s) => s > 0 && s < most).map((s) => {
    const mark = make("i");
    mark.style.left = `${(100 * s) / most}%`;
    return mark;
  });
  const show = (x) => {
    if (Number(input.value) !== x) input.value = x;
    input.style.setProperty("--share", `${(100 * x) / most}%`);
    value.textContent = percent(x);
  };
  input.addEventListener("input", () => moved(Number(input.value)));
  input.addEventListener("dblclick", () => moved(Number(input.value) > 0 ? 0 : 1));
  return { value, track: make("div", { class: "track" }, input, make("div", { class: "ticks" }, ...marks)), show };
}

function row(name, kind, { most = 1, ticks = [], toggled, moved }) {
  const eye = make("button", { type: "button", class: "eye", title: "Show or hide", on: { click: toggled } });
  const { value, track, show } = slider(name, most, ticks, moved);
  const title = make("span", { class: "name", title: name, textContent: name });
  const element = make("div", { class: kind }, make("div", { class: "head" }, eye, title, value), track);
  return {
    element,
    update({ strength, enabled }) {
      show(strength);
      element.classList.toggle("off", !enabled);
      eye.setAttribute("aria-pressed", enabled);
      eye.setAttribute("aria-label", `${enabled ? "Hide" : "Show"} ${name}`);
    },
  };
}

// Fills `root`; `page` has { view, header, change(view), … }. Returns a function that shows the page's new state.
export function buildPanel(root, page) {
  const { header } = page, rows = new Map();
  const change = (list, name, changes) => page.change({
    ...page.view, [list]: page.view[list].map((each) => (each.name === name ? { ...each, ...changes } : each)),
  });
  const add = (list, each, kind, options) => {
    const made = row(each.name, kind, {
      ...options,
      toggled: () => {
        const { enabled } = page.view[list].find((one) => one.name === each.name);
        change(list, each.name, { enabled: !enabled, solo: false });
      },
      moved: (strength) => change(list, each.name, { strength }),
    });
    rows.set(`${list}/${each.name}`, made);
    return made.element;
  };
  const layers = make("section", { class: "layers" });
  let group = null, box = layers;
  for (const layer of [...page.view.layers].reverse()) {  // the top layer first
    if (layer.fixed) continue;
    if (layer.group !== group) {
      group = layer.group;
      box = layers;
      const master = page.view.groups.find((each) => each.name === group);
      if (master) {
        box = make("div", { class: "group" }, add("groups", master, "layer master", {}));
        layers.append(box);
      }
    }
    box.append(add("layers", layer, "layer", { most: header.most, ticks: header.edits[layer.edit].recorded }));
  }
  root.append(layers);
  const parts = [rule(layers, page), snapshots(root, page), timeline(root, page)].filter(Boolean);
  return () => {
    for (const list of ["layers", "groups"]) for (const each of page.view[list]) rows.get(`${list}/${each.name}`)?.update(each);
    for (const update of parts) update();
  };
}

// Creates the choice of the blend rule.
function rule(root, page) {
  if (page.view.layers.length < 2) return null;
  const options = Object.entries(RULES).map(([value, text]) => make("option", { value, textContent: text }));
  const choice = make("select", {
    title: "Blend rule for overlapping edits", "aria-label": "Blend rule",
    on: { change: () => page.change({ ...page.view, blend: choice.value }) },
  }, ...options);
  root.append(make("div", { class: "head rule" }, make("span", { class: "name", textContent: "Blend" }), choice));
  return () => { choice.value = page.view.blend; };
}

function snapshots(root, page) {
  const { snapshots: kept } = page;
  if (kept.length < 2) return null;
  const chips = kept.map((snapshot, index) => make("button", {
    type: "button", class: "chip", textContent: snapshot.name, title: snapshot.name, on: { click: () => page.choose(index) },
  }));
  root.append(make("section", { class: "snapshots" }, make("div", { class: "chips" }, ...chips)));
  return () => chips.forEach((chip, i) => chip.classList.toggle("on", i === page.chosen));
}

function timeline(root, page) {
  const { timeline: film } = page.header;
  if (!film) return null;
  const play = make("button", { type: "button", class: "play", title: "Play (P)", on: { click: () => page.play() } });
  const last = film.frames.length - 1, ticks = film.keys.map((frame) => frame / last);
  const { track, show } = slider("Timeline", 1, ticks, (share) => page.seek(share * last), 0.001);
  root.append(make("section", { class: "timeline" }, play, track));
  return () => {
    show(page.frame / last);
    play.classList.toggle("on", page.playing);
    play.setAttribute("aria-label", page.playing ? "Pause" : "Play");
  };
}
