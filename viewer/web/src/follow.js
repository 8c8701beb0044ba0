// Rows that follow the surface on which they lie; same results as progdf/compose/follow.py.

export const FOLLOWED = ["means", "log_scales", "quats", "logit_opacities"];
const GEOMETRY = FOLLOWED.slice(0, 3), OPACITY = FOLLOWED.slice(3);
const SIZES = { means: 3, log_scales: 3, quats: 4, logit_opacities: 1 };
const ENTRY = 7;  // numbers per following row: row, edit, its own state, four states of anchors
const C1 = 0.4886025119029199;
const C2 = [1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396];
const C3 = [
  -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
  1.445305721320277, -0.5900435899266435,
];
export const MIN_OPACITY = 1e-30;
const MIN_DRAWN_OPACITY = 1 / 255;

export class Surface {
  // `states`: composer of the rows that others follow; `degree`: SH degree of the page; `inverse`: matrix from the
  // colors in the directions of a page's header to SH functions.
  constructor(record, container, states, degree, inverse) {
    this.states = states;
    this.turnBands = record.banded && degree > 0 ? bandTurner(degree, inverse) : null;
    this.picks = record.picks.map((part) => container.stored(part));
    this.table = container.stored(record.followers);
    this.weights = container.real(record.weights);
    this.pushing = record.pushing;
    this.count = record.followers.rows;
    this.painted = {};  // weights of the states' members, by edit and paint
    this.edits = new Set(this.pushing);
    for (let f = 0; f < this.count; f++) this.edits.add(this.table[ENTRY * f + 1]);
  }

  row(f) {
    return this.table[ENTRY * f];
  }

  // Composes the states. Returns whether any has changed.
  update(active, blend) {
    this.active = new Set(active.map((layer) => layer.edit));
    this.pushed = this.pushing.some((edit) => this.active.has(edit));
    if (![...this.active].some((edit) => this.edits.has(edit))) return false;
    const layers = active.filter((layer) => this.picks[layer.edit].length).map((layer) => {
      if (!layer.weights) return layer;
      const key = `${layer.edit}/${layer.paint}`;
      this.painted[key] ??= Float32Array.from(this.picks[layer.edit], (member) => layer.weights[member]);
      return { ...layer, weights: this.painted[key] };
    });
    return this.states.update(layers, blend) !== null;
  }

  // Writes a following row into the arrays of `target`, which hold it as it is without following.
  carry(target, f) {
    const [row, edit, own, ...anchors] = this.table.subarray(ENTRY * f, ENTRY * f + ENTRY);
    if (edit < 0 ? !this.pushed : !this.active.has(edit)) return;
    const { before, after } = this.states, used = anchors.flatMap((state, k) => {
      const weight = this.weights[4 * f + k];
      return weight > 0 ? [{ old: at(before, state), now: at(after, state), weight }] : [];
    });
    const to = at(target, row), from = own < 0 ? to : at(after, own);
    for (const [names, follow] of [[GEOMETRY, carryGeometry], [OPACITY, carryOpacity]]) {
      const differs = (a, b) => names.some((name) => a[name].some((x, c) => x !== b[name][c]));
      const moves = used.some(({ old, now }) => differs(old, now));
      if (moves && (own < 0 || differs(from, used[0].old))) {
        const turn = follow(to, from, used);
        if (turn && own < 0 && this.turnBands) this.turnBands(target.shN, row, turn);
      }
      else for (const name of names) to[name].set((moves ? used[0].now : from)[name]);
    }
  }
}

// Returns the numbers of a row.
function at(arrays, row) {
  return Object.fromEntries(FOLLOWED.map((name) => {
    const width = SIZES[name];
    return [name, arrays[name].subarray(row * width, (row + 1) * width)];
  }));
}

// Writes the geometry, and returns the turn as a unit quaternion.
function carryGeometry(to, from, anchors) {
  const turn = [0, 0, 0, 0], pivot = [0, 0, 0], target = [0, 0, 0];
  let logScale = 0, first = null;
  for (const { old, now, weight } of anchors) {
    const each = multiply(normalized(now.quats), conjugate(normalized(old.quats)));
    first ??= each;
    const sign = each.reduce((sum, q, c) => sum + q * first[c], 0) < 0 ? -1 : 1;
    for (let c = 0; c < 4; c++) turn[c] += weight * sign * each[c];
    for (let c = 0; c < 3; c++) {
      pivot[c] += weight * old.means[c];
      target[c] += weight * now.means[c];
      logScale += (weight * (now.log_scales[c] - old.log_scales[c])) / 3;
    }
  }
  const q = normalized(turn), scale = Math.exp(logScale);
  const arm = [0, ...pivot.map((p, c) => from.means[c] - p)];
  const turned = multiply(multiply(q, arm), conjugate(q));
  to.quats.set(multiply(q, from.quats));
  for (let c = 0; c < 3; c++) {
    to.means[c] = target[c] + scale * turned[c + 1];
    to.log_scales[c] = from.log_scales[c] + logScale;
  }
  return q;
}

// Returns a function that turns the higher SH bands of a row of shN by a unit quaternion. The bands follow from the
// colors that they show in directions that are turned back, see progdf/sh.py.
export function bandTurner(degree, inverse) {
  const bands = (degree + 1) ** 2, count = inverse.length / bands, golden = Math.PI * (1 + Math.sqrt(5));
  const directions = Array.from({ length: count }, (_, j) => {
    const z = 1 - (2 * j + 1) / count, radius = Math.sqrt(1 - z * z), angle = golden * (j + 0.5);
    return [0, radius * Math.cos(angle), radius * Math.sin(angle), z];
  });
  const width = 3 * (bands - 1), sums = new Float64Array(width), color = [0, 0, 0];
  return (shN, row, q) => {
    const own = shN.subarray(row * width, (row + 1) * width);
    if (own.every((x) => x === 0)) return;
    sums.fill(0);
    directions.forEach((direction, j) => {
      const [, x, y, z] = multiply(multiply(conjugate(q), direction), q);
      const functions = higherFunctions(degree, x, y, z);
      color.fill(0);
      for (let k = 0, i = 0; k < bands - 1; k++) for (let c = 0; c < 3; c++, i++) color[c] += functions[k] * own[i];
      for (let k = 1, i = 0; k < bands; k++) {
        for (let c = 0; c < 3; c++, i++) sums[i] += inverse[k * count + j] * color[c];
      }
    });
    own.set(sums);
  };
}

// Returns the values of the SH functions of bands 1 to `degree`, as in progdf/sh.py.
function higherFunctions(degree, x, y, z) {
  const values = [-C1 * y, C1 * z, -C1 * x], xx = x * x, yy = y * y, zz = z * z;
  if (degree > 1) values.push(C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy));
  if (degree > 2) {
    values.push(
      C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, C3[2] * y * (4 * zz - xx - yy), C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
      C3[4] * x * (4 * zz - xx - yy), C3[5] * z * (xx - yy), C3[6] * x * (xx - 3 * yy),
    );
  }
  return values;
}

function carryOpacity(to, from, anchors) {
  const drawn = ({ logit_opacities: [logit] }) => Math.max(sigmoid(logit) - MIN_DRAWN_OPACITY, 0);
  const visible = (each) => anchors.reduce((sum, anchor) => sum + anchor.weight * drawn(anchor[each]), 0);
  const before = visible("old"), ratio = before > 0 ? visible("now") / before : 1;
  const opacity = Math.max(sigmoid(from.logit_opacities[0]) * ratio, MIN_OPACITY);
  to.logit_opacities[0] = ratio < 1 ? Math.log(opacity) - Math.log1p(-opacity) : from.logit_opacities[0];
}

const sigmoid = (x) => 1 / (1 + Math.exp(-x));
const conjugate = ([w, x, y, z]) => [w, -x, -y, -z];

function normalized(q) {
  const length = Math.hypot(...q);
  return length > 0 ? Array.from(q, (x) => x / length) : [1, 0, 0, 0];
}

export function multiply([aw, ax, ay, az], [bw, bx, by, bz]) {
  return [
    aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw,
  ];
}
