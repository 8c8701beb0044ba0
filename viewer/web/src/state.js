// State of the page as data: { layers, groups, blend }, and its changes by snapshots and a timeline; see
// viewer/state/layers.py, snapshots.py.

import { axes, lookAlong, unit, wrap } from "./camera.js";

// Returns the visible layers, each at its strength times its group's.
export function visibleLayers({ layers, groups }) {
  const group = new Map(groups.map((each) => [each.name, each]));
  const alone = layers.filter((layer) => layer.solo);
  const shown = alone.length ? alone : layers.filter((l) => l.enabled && (group.get(l.group)?.enabled ?? true));
  return shown.map((layer) => ({ ...layer, strength: layer.strength * (group.get(layer.group)?.strength ?? 1) }));
}

// Returns the view with the edits of a snapshot; layers that it lacks stay, at 0.
export function restore(view, snapshot) {
  const known = new Set(snapshot.layers.map((layer) => layer.edit));
  const later = view.layers.filter((l) => !known.has(l.edit)).map((l) => ({ ...l, strength: 0, group: "" }));
  return { ...view, layers: [...snapshot.layers, ...later], groups: snapshot.groups, blend: snapshot.blend };
}

const lerp = (a, b, share) => a + share * (b - a);

// Interpolates two cameras along the shortest rotation.
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

// Returns view and camera at a (fractional) frame of a film.
export function stateAt({ frames }, frame, view, camera) {
  const before = Math.min(Math.floor(frame), frames.length - 1), share = frame - before;
  const here = frames[before], next = frames[Math.min(before + 1, frames.length - 1)];
  const strengths = new Map(here.strengths.map(([edit, s], i) => [edit, lerp(s, next.strengths[i][1], share)]));
  const layers = view.layers.map((layer) => ({ ...layer, strength: strengths.get(layer.edit) ?? layer.strength }));
  return { view: { ...view, layers }, camera: here.camera ? mixCameras(here.camera, next.camera, share) : camera };
}
