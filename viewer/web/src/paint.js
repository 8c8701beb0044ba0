// Order of painted layers: the upper one covers the lower one; same results as progdf/compose/overlap.py.

import { MIN_OPACITY } from "./follow.js";

export const ARRANGED = ["means", "logit_opacities", "sh0"];
const FADE_POWER = 8;

export class PaintOrder {
  // `tints`: composer of the rows whose colors the rims take; null without any.
  constructor(record, container, tints) {
    for (const name of ["rows", "edits", "members"]) this[name] = container.stored(record[name]);
    this.rim = container.real(record.rim);
    this.outward = container.real(record.outward);
    const read = (part) => (part.type === "i4" ? container.stored(part) : container.real(part));
    this.pairs = record.pairs.map(({ upper, lower, ...parts }) => (
      { upper, lower, ...Object.fromEntries(Object.entries(parts).map(([name, part]) => [name, read(part)])) }));
    this.tints = tints;
    if (tints) {
      this.picks = record.tints.picks.map((part) => container.stored(part));
      this.table = container.stored(record.tints.followers);
      this.weights = container.real(record.tints.weights);
      this.place = new Map(Array.from(this.rows, (row, i) => [row, i]));
    }
    this.key = "";
  }

  // Returns whether a run of rows has paint.
  touches(first, rows) {
    return this.rows.some((row) => row >= first && row < first + rows);
  }

  // Returns whether the order of the paint, or what lies below its rims, has changed.
  update(active, blend) {
    this.layers = active.filter(({ edit }) => this.edits.includes(edit));
    const key = this.layers.map(({ effect }) => effect).join(), moved = key !== this.key;
    this.key = key;
    if (!this.tints) return moved;
    const layers = active.filter(({ edit }) => this.picks[edit].length).map((layer) => (layer.weights
      ? { ...layer, weights: Float32Array.from(this.picks[layer.edit], (member) => layer.weights[member]) } : layer));
    return this.tints.update(layers, blend) !== null || moved;
  }

  // Moves, fades and recolors the rows of paint in some segments of `after`.
  arrange(after, segments) {
    const { rows, edits, members, rim, outward } = this, count = rows.length;
    const { means, logit_opacities: logits, sh0 } = after;
    const isRewritten = Uint8Array.from(rows, (row) =>
      segments.some(({ first, rows: length }) => row >= first && row < first + length));
    const opacity = new Float64Array(count), risen = new Float64Array(count), kept = new Float64Array(count).fill(1);
    const own = Float64Array.from({ length: 3 * count }, (_, j) => sh0[3 * rows[Math.floor(j / 3)] + (j % 3)]);
    const beside = own.slice(), color = own.slice();
    this.#tint(beside);
    for (const layer of this.layers) {
      const strength = Math.min(Math.max(layer.strength, 0), 1) * Math.min(Math.abs(layer.gains.opacity), 1);
      for (let i = 0; i < count; i++) {
        if (edits[i] !== layer.edit) continue;
        opacity[i] = Math.max(opacity[i], strength * (layer.weights ? layer.weights[members[i]] : 1));
      }
    }
    const order = this.layers.map((layer) => layer.edit).filter((edit, i, all) => all.lastIndexOf(edit) === i);
    order.forEach((upper, position) => {
      for (const lower of order.slice(0, position)) {
        const pair = this.pairs.find((each) => each.upper === upper && each.lower === lower);
        if (pair) cover(pair, { opacity, risen, kept, beside, color });
      }
      for (let i = 0; i < count; i++) {
        if (edits[i] !== upper || !isRewritten[i]) continue;
        for (let j = 3 * i; j < 3 * i + 3; j++) color[j] += rim[i] * (beside[j] - own[j]);
      }
    });
    for (let i = 0; i < count; i++) {
      if (!isRewritten[i] || opacity[i] === 0) continue;
      const row = rows[i];
      for (let c = 0; c < 3; c++) {
        if (color[3 * i + c] !== own[3 * i + c]) sh0[3 * row + c] = color[3 * i + c];
        if (risen[i] > 0) means[3 * row + c] += risen[i] * outward[3 * i + c];
      }
      if (kept[i] < 1) {
        const visible = Math.max(kept[i] / (1 + Math.exp(-logits[row])), MIN_OPACITY);
        logits[row] = Math.log(visible) - Math.log1p(-visible);
      }
    }
  }

  // Adds the change of the surface beside the paint to colors.
  #tint(beside) {
    if (!this.tints) return;
    const { before: { sh0: before }, after: { sh0: after } } = this.tints;
    for (let f = 0; f < this.weights.length / 4; f++) {
      const [row, , , ...states] = this.table.subarray(7 * f, 7 * f + 7), i = this.place.get(row);
      states.forEach((state, k) => {
        for (let c = 0; c < 3; c++) {
          beside[3 * i + c] += this.weights[4 * f + k] * (after[3 * state + c] - before[3 * state + c]);
        }
      });
    }
  }
}

// Lets a layer of paint cover a lower one.
function cover(pair, { opacity, risen, kept, beside, color }) {
  pair.over.forEach((i, p) => {
    const under = pair.under[p], share = pair.cover[p] * opacity[under];
    risen[i] = Math.max(risen[i], pair.rise[p] + risen[under]);
    for (let c = 0; c < 3; c++) beside[3 * i + c] += share * (color[3 * under + c] - beside[3 * i + c]);
  });
  pair.hidden.forEach((i, h) => {
    kept[i] *= 1 - pair.share[h] * opacity[pair.above[h]] ** FADE_POWER;
  });
}
