// The turntable camera of viewer/camera/view_camera.py and controls.py: { pivot, distance, azimuth, elevation, fov_y, up }.

const DEGREES_PER_PIXEL = 0.3;
const CLOSEST = 1e-4, WIDEST = 1e4;  // distances, as a factor of the scene's radius
const FARTHEST = 1e9;
const radians = (degrees) => (degrees * Math.PI) / 180;
export const wrap = (degrees) => ((((degrees + 180) % 360) + 360) % 360) - 180;
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const addScaled = (origin, ...steps) =>
  steps.reduce((sum, [length, way]) => sum.map((x, i) => x + length * way[i]), origin);

export function unit(v, otherwise) {
  const length = Math.hypot(...v);
  return length > 0 && length < Infinity ? v.map((x) => x / length) : otherwise;
}

function front(up) {
  const size = up.map(Math.abs), largest = size.indexOf(Math.max(...size)), sign = Math.sign(up[largest]) || 1;
  const facing = [[0, 0, sign], [0, 0, sign], [0, -sign, 0]][largest];
  return unit(addScaled(facing, [-dot(facing, up), up]), [1, 0, 0]);
}

// Unit vectors of the picture in world space: right, up, and back (from the pivot to the eye).
export function axes(camera) {
  const up = unit(camera.up, [0, 1, 0]), ahead = front(up), side = cross(up, ahead);
  const azimuth = radians(camera.azimuth), elevation = radians(camera.elevation);
  const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
  const level = addScaled([0, 0, 0], [ca, ahead], [sa, side]), zero = [0, 0, 0];
  return {
    right: addScaled(zero, [ca, side], [-sa, ahead]),
    up: addScaled(zero, [ce, up], [-se, level]),
    back: addScaled(zero, [se, up], [ce, level]),
  };
}

export const eyeOf = (camera) => addScaled(camera.pivot, [camera.distance, axes(camera).back]);

// The pinhole camera of a picture [width, height] centered on its left and top part of the size `free`.
// A part narrower than high has the horizontal field of view of a square.
export function pinhole(camera, width, height, free) {
  const picture = axes(camera), eye = eyeOf(camera);
  const focal = Math.min(...free) / 2 / Math.tan(radians(camera.fov_y) / 2);
  const rows = [picture.right, picture.up.map((x) => -x), picture.back.map((x) => -x)];
  return {
    rows, eye, width, height,
    intrinsics: [focal, focal, free[0] / 2, free[1] / 2],
  };
}

const isFinite3 = (camera) =>
  [...camera.pivot, camera.distance, camera.azimuth, camera.elevation].every((x) => Math.abs(x) <= FARTHEST) &&
  camera.distance > 0;
const keepFinite = (now, before) => (isFinite3(now) ? now : before);
const held = (distance, radius) => Math.min(Math.max(distance, CLOSEST * radius), WIDEST * radius);

export function orbit(camera, dx, dy) {
  const elevation = Math.min(Math.max(camera.elevation + DEGREES_PER_PIXEL * dy, -90), 90);
  const azimuth = wrap(camera.azimuth - DEGREES_PER_PIXEL * dx);
  return keepFinite({ ...camera, azimuth, elevation }, camera);
}

// Points at the pivot's depth stay under the pointer; focal: px, from `pinhole`.
export function pan(camera, dx, dy, focal) {
  const perPixel = camera.distance / focal, picture = axes(camera);
  const pivot = addScaled(camera.pivot, [-dx * perPixel, picture.right], [dy * perPixel, picture.up]);
  return keepFinite({ ...camera, pivot }, camera);
}

export const zoom = (camera, factor, radius) =>
  keepFinite({ ...camera, distance: held(camera.distance * factor, radius) }, camera);

// The camera with the same pivot and distance that looks along -back.
export function lookAlong(camera, back) {
  const up = unit(camera.up, [0, 1, 0]), ahead = front(up), way = unit(back, axes(camera).back);
  const height = Math.min(Math.max(dot(way, up), -1), 1), level = addScaled(way, [-height, up]);
  const flat = dot(level, level);
  const azimuth = flat > 1e-18 ? Math.atan2(dot(level, cross(up, ahead)), dot(level, ahead)) : null;
  return {
    ...camera,
    azimuth: azimuth === null ? camera.azimuth : (azimuth * 180) / Math.PI,
    elevation: (Math.atan2(height, Math.sqrt(flat)) * 180) / Math.PI,
  };
}

// The camera with the same eye that looks at `point`, its new pivot.
export function pivotOn(camera, point, radius) {
  const eye = eyeOf(camera), back = addScaled(eye, [-1, point]);
  return keepFinite({ ...lookAlong({ ...camera, pivot: point }, back), distance: held(Math.hypot(...back), radius) }, camera);
}
