// What the page shows, as data: { layers, groups, blend } and how snapshots and a timeline change it; see
// viewer/state/layers.py, snapshots.py.

import { axes, lookAlong, unit, wrap } from "./camera.js";

// The layers that take part, each at its strength times its group's.
export function visibleLayers({ layers, groups }) {
  const group = new Map(groups.map((each) => [each.name, each]));
  const alone = layers.filter((layer) => layer.solo);
  const shown = alone.length ? alone : layers.filter((l) => l.enabled && (group.get(l.group)?.enabled ?? true));
  return shown.map((layer) => ({ ...layer, strength: layer.strength * (group.get(layer.group)?.strength ?? 1) }));
}

// The view edited as a snapshot has it; layers that it does not know stay, at 0.
export function restore(view, snapshot) {
  const known = new Set(snapshot.layers.map((layer) => layer.edit));
  const later = view.layers.filter((l) => !known.has(l.edit)).map((l) => ({ ...l, strength: 0, group: "" }));
  return { ...view, layers: [...snapshot.layers, ...later], groups: snapshot.groups, blend: snapshot.blend };
}

const lerp = (a, b, share) => a + share * (b - a);

// Between two values; what is off at one end is 0 there, unless it is off at both.
function fade(on, values, share) {
  const [a, b] = values.map((value, i) => (on[i] || !(on[0] || on[1]) ? value : 0));
  return lerp(a, b, share);
}

const setsOf = (view) => Object.fromEntries(view.groups.map(({ name }) =>
  [name, view.layers.filter((l) => l.group === name).map((l) => l.edit).sort().join()]));

// The view between snapshots: as `a` at 0, as `b` at 1, each exactly.
export function between(view, a, b, share) {
  const faded = (snapshot) => ({ ...snapshot, layers: snapshot.layers.map((l) => ({ ...l, strength: 0 })) });
  const ends = [restore(view, a.original ? faded(b) : a), restore(view, b.original ? faded(a) : b)];
  if (share <= 0 || share >= 1) return ends[share <= 0 ? 0 : 1];
  const [near, far] = share < 0.5 ? ends : [ends[1], ends[0]];
  const known = new Set(near.layers.map((layer) => layer.edit));
  const stack = [...near.layers, ...far.layers.filter((l) => !known.has(l.edit)).map((l) => ({ ...l, group: "" }))];
  const alone = ends.some((end) => end.layers.some((layer) => layer.solo));
  const [one, two] = ends.map(setsOf), shared = (name) => !alone && one[name] !== undefined && one[name] === two[name];
  const groups = near.groups.map((group) => {
    if (!shared(group.name)) return { ...group, enabled: true, strength: 1 };
    const both = ends.map((end) => end.groups.find((each) => each.name === group.name));
    const on = both.map((each) => each.enabled);
    return { ...group, enabled: on[0] || on[1], strength: fade(on, both.map((each) => each.strength), share) };
  });
  const seen = ends.map((end) => new Map(visibleLayers(end).map((layer) => [layer.edit, layer.strength])));
  const layers = stack.map((layer) => {
    let both = ends.map((end) => end.layers.find((l) => l.edit === layer.edit) ?? { ...layer, strength: 0, enabled: false });
    let visible = seen.map((of) => of.has(layer.edit));
    let strengths = seen.map((of, i) => of.get(layer.edit) ?? both[i].strength);
    if (shared(layer.group)) [visible, strengths] = [both.map((l) => l.enabled), both.map((l) => l.strength)];
    const on = visible.map((here, i) => here && strengths[i] !== 0);
    if (on[0] !== on[1]) both = on[0] ? [both[0], both[0]] : [both[1], both[1]];
    const gains = Object.fromEntries(Object.keys(layer.gains).map((kind) =>
      [kind, lerp(both[0].gains[kind], both[1].gains[kind], share)]));
    const paint = both[0].paint === both[1].paint ? both[0].paint : [both[0].paint, both[1].paint, share];
    return {
      ...layer, gains, paint, solo: false, enabled: visible[0] || visible[1], strength: fade(visible, strengths, share),
    };
  });
  return { ...near, layers, groups };
}

// A camera between two others, the shortest way around.
export function mixCameras(a, b, share) {
  if (share <= 0 || share >= 1) return share <= 0 ? a : b;
  const camera = {
    ...a,
    pivot: a.pivot.map((x, axis) => lerp(x, b.pivot[axis], share)),
    distance: Math.exp(lerp(Math.log(a.distance), Math.log(b.distance), share)),
    fov_y: lerp(a.fov_y, b.fov_y, share),
    azimuth: wrap(a.azimuth + share * wrap(b.azimuth - a.azimuth)),
    elevation: lerp(a.elevation, b.elevation, share),
  };
  if (a.up.every((x, axis) => x === b.up[axis])) return camera;
  const [from, to] = [axes(a), axes(b)];
  const mixed = (name) => unit(from[name].map((x, axis) => lerp(x, to[name][axis], share)), from[name]);
  return lookAlong({ ...camera, up: mixed("up") }, mixed("back"));
}

// The view and the camera at a moment of a film, whose frames are given one by one.
export function stateAt({ frames }, frame, view, camera) {
  const before = Math.min(Math.floor(frame), frames.length - 1), share = frame - before;
  const here = frames[before], next = frames[Math.min(before + 1, frames.length - 1)];
  const strengths = new Map(here.strengths.map(([edit, s], i) => [edit, lerp(s, next.strengths[i][1], share)]));
  const layers = view.layers.map((layer) => ({ ...layer, strength: strengths.get(layer.edit) ?? layer.strength }));
  return { view: { ...view, layers }, camera: here.camera ? mixCameras(here.camera, next.camera, share) : camera };
}
