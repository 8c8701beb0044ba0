// What the page shows, as data: { layers, groups, blend } and how snapshots and a timeline change it; see
// viewer/state/layers.py, snapshots.py, timeline.py and viewer/camera/views.py.

import { axes, lookAlong, unit } from "./camera.js";

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

// Which point comes before a frame, and how much of the way to the next lies behind.
function segment(frames, frame) {
  if (frame <= frames[0]) return [0, 0];
  for (let i = 0; i + 1 < frames.length; i++) {
    if (frames[i] <= frame && frame < frames[i + 1]) return [i, (frame - frames[i]) / (frames[i + 1] - frames[i])];
  }
  return [frames.length - 1, 0];
}

function slope(points, i) {
  if (i === 0 || i === points.length - 1 || points[i - 1][1] !== "smooth" || points[i][1] !== "smooth") return 0;
  const [[a, , x], [b, , y], [c, , z]] = points.slice(i - 1, i + 2), into = (y - x) / (b - a), out = (z - y) / (c - b);
  if (into * out <= 0) return 0;
  const left = 2 * (c - b) + (b - a), right = c - b + 2 * (b - a);
  return (left + right) / (left / into + right / out);
}

// A track's value at a frame; points: [frame, easing, value].
export function valueBetween(points, frame) {
  const [i, share] = segment(points.map((point) => point[0]), frame), [at, easing, start] = points[i];
  if (share === 0 || easing === "hold") return start;
  const [next, , end] = points[i + 1];
  if (easing === "linear") return lerp(start, end, share);
  const leave = slope(points, i) * (next - at), come = slope(points, i + 1) * (next - at);
  const reached = start + share * share * (3 - 2 * share) * (end - start)
    + share * (1 - share) * ((1 - share) * leave - share * come);
  return Math.min(Math.max(reached, Math.min(start, end)), Math.max(start, end));
}

// The camera between keys [frame, easing, camera].
export function cameraBetween(keys, frame) {
  const [i, share] = segment(keys.map((key) => key[0]), frame), here = keys[i][2];
  if (share === 0 || keys[i][1] === "hold") return here;
  const there = keys[i + 1][2];
  const track = (of) => valueBetween(keys.map(([at, easing, camera]) => [at, easing, of(camera)]), frame);
  const camera = {
    ...here,
    pivot: [0, 1, 2].map((axis) => track((c) => c.pivot[axis])),
    distance: Math.exp(track((c) => Math.log(Math.max(c.distance, 1e-300)))),
    fov_y: track((c) => c.fov_y),
  };
  if (here.up.some((x, axis) => x !== there.up[axis])) {
    const eased = valueBetween([[0, keys[i][1], 0], [1, keys[i][1], 1]], share);
    const [a, b] = [axes(here), axes(there)];
    const mixed = (name) => unit(a[name].map((x, axis) => lerp(x, b[name][axis], eased)), a[name]);
    return lookAlong({ ...camera, up: mixed("up") }, mixed("back"));
  }
  let last = null;
  const turns = new Map(keys.map(([, , c]) => {  // each within half a turn of the one before it
    last = last === null ? c.azimuth : last + ((((c.azimuth - last + 180) % 360) + 360) % 360) - 180;
    return [c, last];
  }));
  const azimuth = ((((track((c) => turns.get(c)) + 180) % 360) + 360) % 360) - 180;
  return { ...camera, azimuth, elevation: track((c) => c.elevation) };
}

// The view and the camera at a frame of a timeline.
export function stateAt(timeline, frame, view, camera) {
  const tracks = new Map(), cameras = [];
  for (const key of timeline.keys) {
    for (const [edit, strength] of key.strengths) {
      if (!tracks.has(edit)) tracks.set(edit, []);
      tracks.get(edit).push([key.frame, key.easing, strength]);
    }
    if (key.camera) cameras.push([key.frame, key.easing, key.camera]);
  }
  const layers = view.layers.map((layer) =>
    tracks.has(layer.edit) ? { ...layer, strength: valueBetween(tracks.get(layer.edit), frame) } : layer);
  return { view: { ...view, layers }, camera: cameras.length ? cameraBetween(cameras, frame) : camera };
}
