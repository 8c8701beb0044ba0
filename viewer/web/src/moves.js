// Moves that carry the changes and the added rows of other layers; same results as progdf/compose/parents/rows.py.

import { bandTurner, multiply } from "./follow.js";

export const MOVED = ["means", "log_scales", "quats", "shN"];
const MIN_FLATNESS = 0.01, SIMILAR_TOLERANCE = 1e-9, SHAPE_ROUNDING = 1e-6, SWEEPS = 5;
const PLANES = [[0, 1], [0, 2], [1, 2]];

export class Carrier {
  // `records`: header entries of the moves; `fields`: their offsets, as edits
  constructor(records, fields, container, composer) {
    this.composer = composer;
    this.bands = container.header.sh;
    const turn = this.bands ? bandTurner(Math.sqrt(this.bands + 1) - 1, container.header.sphere[1]) : null;
    this.names = MOVED.filter((name) => composer.after[name]);
    this.moves = records.map((record, i) => ({
      ...record,
      field: fields[i],
      parts: container.stored(record.parts),
      turn,
      added: record.added.map((each) => ({
        edit: each.edit, rows: container.stored(each.rows), weights: container.real(each.weights),
      })),
    }));
    this.stack = [];
    this.effect = "";
  }

  // Prepares the active moves. Returns whether any has changed.
  update(active) {
    const stack = active.flatMap((layer) => this.moves.filter(({ edit }) => edit === layer.edit).map((move) => [move, layer]));
    const effect = JSON.stringify([stack.map(([, layer]) => layer.effect), active.map(({ edit }) => edit)]);
    if (effect === this.effect) return false;
    this.effect = effect;
    this.active = new Set(active.map(({ edit }) => edit));
    this.stack = stack.map(([move, layer]) => ({
      move, layer, maps: move.motions.map((part) => linearMap(part, layer.strength, this.bands, move.turn)), known: {},
    }));
    return true;
  }

  // Returns whether moves can act on a segment.
  touches(segment) {
    segment.moved ??= this.moves.some((move) => move.edit in segment.members || move.added.some(({ rows }) => {
      const [from, to] = range(rows, segment);
      return from < to;
    }));
    return segment.moved;
  }

  // Writes the moved attributes of a segment.
  carry(segment) {
    const { first, rows } = segment, { below, after, widths } = this.composer;
    for (const name of this.names) {
      const width = widths[name];
      after[name].set(below[name].subarray(first * width, (first + rows) * width), first * width);
    }
    for (const one of this.touches(segment) ? this.stack : []) {
      for (const each of one.move.added) if (this.active.has(each.edit)) this.#carryAdded(one, each, segment);
      if (one.move.edit in segment.members) this.#carryMembers(one, segment);
    }
  }

  // Returns the offsets of an attribute for members from `member` on.
  #offsets({ move, layer }, name, member, count) {
    const bases = move.field.attributes[name], width = this.composer.widths[name];
    const offsets = new Float32Array(count * width);
    if (bases) move.field.offsets(bases, layer.strength, member * width, offsets, new Float32Array(count * width));
    return offsets;
  }

  #carryMembers(one, segment) {
    const { first, rows } = segment, { move, layer, maps } = one, member = segment.members[move.edit];
    const { before, after, widths } = this.composer;
    const offsets = Object.fromEntries(this.names.map((name) => [name, this.#offsets(one, name, member, rows)]));
    for (let i = 0; i < rows; i++) {
      const weight = layer.weights?.[member + i] ?? 1;
      if (weight === 0) continue;
      const old = rowAt(before, this.names, widths, first + i), now = rowAt(after, this.names, widths, first + i);
      const map = maps[move.parts[member + i]], differs = {}, moved = {};
      for (const name of this.names) {
        const width = widths[name], factor = Math.fround(Math.fround(weight) * Math.fround(gainOf(layer, name)));
        differs[name] = now[name].some((x, c) => x !== old[name][c]);
        moved[name] = Float64Array.from(now[name], (x, c) => x + Math.fround(factor * offsets[name][i * width + c]));
      }
      if (map && !map.still) carryDisplaced(old, now, moved, differs, map, weight, layer.gains);
      for (const name of this.names) now[name].set(moved[name]);
    }
  }

  #carryAdded(one, { rows: table, weights }, segment) {
    const { move, layer, maps } = one, { before, after, widths } = this.composer, [from, to] = range(table, segment);
    const size = move.parts.length, means = (one.known.means ??= this.#offsets(one, "means", 0, size));
    const start = this.#starts(move.edit);
    for (let f = from; f < to; f++) {
      const row = rowAt(after, this.names, widths, table[5 * f]), shares = maps.map(() => 0);
      const steps = [0, 0, 0];
      for (let k = 0; k < 4; k++) {
        const member = table[5 * f + 1 + k], part = move.parts[member], map = maps[part];
        const share = weights[4 * f + k] * (layer.weights?.[member] ?? 1);
        if (!(share > 0) || !map) continue;
        shares[part] += share;
        const at = before.means.subarray(3 * start[member], 3 * start[member] + 3);
        const arm = apply(map.matrix, Array.from(row.means, (x, c) => x - at[c]));
        for (let c = 0; c < 3; c++) {
          steps[c] += share * layer.gains.geometry * (at[c] + means[3 * member + c] + arm[c] - row.means[c]);
        }
      }
      const own = Object.fromEntries(this.names.map((name) => [name, Float64Array.from(row[name])]));
      const total = Object.fromEntries(this.names.map((name) => [name, Float64Array.from(row[name])]));
      for (let c = 0; c < 3; c++) total.means[c] += steps[c];
      maps.forEach((map, part) => {
        if (!shares[part] || map.still) return;
        const shape = mapShape(own.log_scales, own.quats, map), factor = shares[part] * layer.gains.geometry;
        for (let c = 0; c < 3; c++) total.log_scales[c] += factor * (shape.logScales[c] - own.log_scales[c]);
        for (let c = 0; c < 4; c++) total.quats[c] += factor * (shape.quats[c] - own.quats[c]);
        if (own.shN) addBands(total.shN, own.shN, map, shares[part] * layer.gains.color);
      });
      for (const name of this.names) row[name].set(total[name]);
    }
  }

  // Returns the row of each member of an edit.
  #starts(edit) {
    this.rows ??= {};
    this.rows[edit] ??= Int32Array.from(this.composer.segments.filter(({ members }) => edit in members)
      .flatMap(({ first, rows }) => Array.from({ length: rows }, (_, i) => first + i)));
    return this.rows[edit];
  }
}

const gainOf = ({ gains }, name) => (name === "shN" ? gains.color : gains.geometry);

// Returns the first and last entry of a table of rows, five numbers each, that lie in a segment.
function range(table, { first, rows }) {
  const search = (row) => {
    let low = 0, high = table.length / 5;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (table[5 * middle] < row) low = middle + 1;
      else high = middle;
    }
    return low;
  };
  return [search(first), search(first + rows)];
}

const rowAt = (arrays, names, widths, row) => Object.fromEntries(names.map((name) =>
  [name, arrays[name].subarray(row * widths[name], (row + 1) * widths[name])]));

// Carries a member that other layers have changed.
function carryDisplaced(old, now, moved, differs, map, weight, gains) {
  const factor = weight * gains.geometry, minus = (name) => Array.from(now[name], (x, c) => x - old[name][c]);
  if (differs.means) {
    const change = minus("means"), carried = apply(map.matrix, change);
    for (let c = 0; c < 3; c++) moved.means[c] += factor * (carried[c] - change[c]);
  }
  const changes = [...minus("log_scales"), ...minus("quats")];
  if (map.similar && differs.quats) {
    const change = minus("quats"), carried = multiply(map.turn, change);
    for (let c = 0; c < 4; c++) moved.quats[c] += factor * (carried[c] - change[c]);
  } else if (!map.similar && changes.some((x) => Math.abs(x) > SHAPE_ROUNDING)) {
    const shape = mapShape(now.log_scales, now.quats, map), mix = (a, b) => a + factor * (b - a);
    moved.log_scales.set(now.log_scales);
    moved.quats.set(now.quats);
    for (let c = 0; c < 3; c++) moved.log_scales[c] = mix(now.log_scales[c], shape.logScales[c]);
    for (let c = 0; c < 4; c++) moved.quats[c] = mix(now.quats[c], shape.quats[c]);
  }
  if (differs.shN) addBands(moved.shN, minus("shN"), map, weight * gains.color);
}

// Adds the change of higher bands by a map, times a factor.
function addBands(total, bands, { bandMatrix }, factor) {
  const count = bands.length / 3;
  for (let i = 0; i < count; i++) {
    for (let c = 0; c < 3; c++) {
      let sum = -bands[3 * i + c];
      for (let k = 0; k < count; k++) sum += bandMatrix[k][3 * i] * bands[3 * k + c];
      total[3 * i + c] += factor * sum;
    }
  }
}

function mapShape(logScales, quats, map) {
  if (!map.similar) return stretchAxes(logScales, quats, map.shape);
  return { logScales: Array.from(logScales, (x) => x + map.logScale), quats: multiply(map.turn, quats) };
}

// Returns the linear map of motions in a row, see progdf/gdf/motions.py.
function linearMap(motions, strength, count, turnBands) {
  let matrix = identity(), shape = identity(), turn = [1, 0, 0, 0];
  // higher bands of the unit vectors, as rows of three equal channels
  const bandMatrix = Array.from({ length: count }, (_, k) => new Float64Array(3 * count).fill(1, 3 * k, 3 * k + 3));
  for (const motion of motions) {
    const angle = Math.hypot(...motion.turn) * strength, half = Math.sin(angle / 2) / (Math.hypot(...motion.turn) || 1);
    const each = [Math.cos(angle / 2), ...motion.turn.map((x) => x * half)], columns = axesOf(each);
    const stretch = identity().map((row, i) => row.map((_, j) => motion.logs.reduce((sum, log, k) =>
      sum + motion.axes[i][k] * Math.exp(strength * log) * motion.axes[j][k], 0)));
    const whole = product(columns, stretch), factor = 1 - 2 * strength, axis = motion.mirror;
    const flat = Math.abs(factor) >= MIN_FLATNESS ? factor : factor >= 0 ? MIN_FLATNESS : -MIN_FLATNESS;
    const scaled = (by) => whole.map((row) => row.map((x, j) => (j === axis ? x * by : x)));
    matrix = product(scaled(factor), matrix);
    shape = product(scaled(flat), shape);
    if (axis !== null && strength > 0.5) turn = multiply([0, +(axis === 0), +(axis === 1), +(axis === 2)], turn);
    turn = multiply(each, turn);
    for (const bands of bandMatrix) {
      if (motion.parity) for (let i = 0; i < 3 * count; i++) {
        bands[i] += strength * (motion.parity[Math.floor(i / 3)] - 1) * bands[i];
      }
      if (angle) turnBands(bands, 0, each);
    }
  }
  const squares = product(transposed(shape), shape), square = (squares[0][0] + squares[1][1] + squares[2][2]) / 3;
  const similar = squares.every((row, i) => row.every((x, j) => Math.abs(x / square - (i === j)) <= SIMILAR_TOLERANCE));
  const still = [matrix, shape].every((each) => each.every((row, i) => row.every((x, j) => x === +(i === j))));
  return { matrix, shape, turn, similar, still, logScale: 0.5 * Math.log(square), bandMatrix };
}

// Returns log-scales and a quaternion of the covariance G Σ Gᵀ, by Jacobi rotations; see progdf/similarity.py.
function stretchAxes(logScales, quats, shape) {
  const largest = Math.max(...logScales), length = Math.hypot(...quats) || 1;
  let axes = axesOf(Array.from(quats, (x) => x / length));
  const local = product(product(transposed(axes), shape), axes);
  const half = local.map((row) => row.map((x, j) => x * Math.exp(logScales[j] - largest)));
  let matrix = product(half, transposed(half));
  for (let sweep = 0; sweep < SWEEPS; sweep++) {
    for (const [i, j] of PLANES) {
      const mixed = matrix[i][j], first = matrix[i][i], second = matrix[j][j];
      let tangent = 0;
      if (Math.abs(mixed) > 1e-16 * (first + second)) {
        const ratio = (second - first) / (2 * mixed);
        tangent = (ratio < 0 ? -1 : 1) / (Math.abs(ratio) + Math.sqrt(1 + ratio * ratio));
      }
      const cosine = 1 / Math.sqrt(1 + tangent * tangent), sine = cosine * tangent;
      const turned = (rows) => rows.map((row) =>
        row.with(i, cosine * row[i] - sine * row[j]).with(j, sine * row[i] + cosine * row[j]));
      matrix = transposed(turned(transposed(turned(matrix))));
      axes = turned(axes);
    }
  }
  const q = quaternionOf(axes), sign = q.reduce((sum, x, c) => sum + x * quats[c], 0) < 0 ? -1 : 1;
  return {
    logScales: [0, 1, 2].map((c) => largest + 0.5 * Math.log(Math.max(matrix[c][c], 1e-300))),
    quats: q.map((x) => sign * length * x),
  };
}

const identity = () => [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
const transposed = (a) => a[0].map((_, j) => a.map((row) => row[j]));
const apply = (a, x) => a.map((row) => row[0] * x[0] + row[1] * x[1] + row[2] * x[2]);
const product = (a, b) => a.map((row) => [0, 1, 2].map((j) => row[0] * b[0][j] + row[1] * b[1][j] + row[2] * b[2][j]));

// Returns the rotation matrix of a unit quaternion.
function axesOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

// Returns the unit quaternion of a rotation matrix, by its largest component.
function quaternionOf([[x, f, b], [c, y, d], [e, a, z]]) {
  const sums = [1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], best = sums.indexOf(Math.max(...sums));
  const q = [
    [sums[0], a - d, b - e, c - f], [a - d, sums[1], c + f, b + e],
    [b - e, c + f, sums[2], a + d], [c - f, b + e, a + d, sums[3]],
  ][best];
  const length = Math.hypot(...q);
  return q.map((number) => number / length);
}
