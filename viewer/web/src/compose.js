// The scene under a stack of edits, members only: the numbers of progdf/compose/reference.py.

import { gradeChange } from "./grade.js";

export const WIDTHS = { means: 3, log_scales: 3, quats: 4, logit_opacities: 1, sh0: 3 };
export const KINDS = {
  means: "geometry", log_scales: "geometry", quats: "geometry",
  logit_opacities: "opacity", sh0: "color", shN: "color",
};
const PARTNERS = { means: "logit_opacities", logit_opacities: "means" };  // share a texture
const { fround } = Math;

// The segment of ascending knots that holds x: the index of its right one, and the share of the way to that.
export function findSegment(knots, x) {
  const at = fround(x);
  let right = 1;
  while (right < knots.length - 1 && knots[right] < at) right++;
  return [right, (x - knots[right - 1]) / (knots[right] - knots[right - 1])];
}

class Edit {
  constructor(container, record) {
    const read = (part) => part.map((row) => Float32Array.from(row));
    this.name = record.name;
    this.recorded = record.recorded;
    this.knots = Float32Array.from(record.knots);
    this.members = container.stored(record.members);
    for (let i = 1; i < this.members.length; i++) this.members[i] += this.members[i - 1];
    this.attributes = {};
    for (const [name, bases] of Object.entries(record.attributes)) {
      this.attributes[name] = {
        stored: [bases.end, ...bases.residual].map((part) => container.stored(part)),
        scale: read(bases.scale),
        coefficients: read(bases.coefficients),
      };
    }
    this.coverage = {};
    for (const [kind, part] of Object.entries(record.coverage ?? {})) this.coverage[kind] = container.real(part);
    this.grade = record.grade && {
      ...record.grade,
      table: record.grade.table.map((part) => container.real(part)),
      residual: record.grade.residual.map((part) => container.stored(part)),
      share: record.grade.share && container.real(record.grade.share),
    };
  }

  // What each stored base of an attribute is multiplied with at a strength: pairs of numbers and a factor a channel.
  factors(name, strength) {
    const { stored, scale, coefficients } = this.attributes[name];
    const [right, share] = findSegment(this.knots, strength);
    const low = coefficients[right - 1], high = coefficients[right], used = [];
    stored.forEach((numbers, k) => {
      const a = share === 1 ? high[k] : fround(low[k] + fround(share) * (high[k] - low[k]));
      if (a !== 0) used.push([numbers, scale[k].map((unit) => a * unit)]);
    });
    return used;
  }
}

export class Composer {
  constructor(container) {
    const { header } = container;
    this.count = header.members;
    this.edits = header.edits.map((record) => new Edit(container, record));
    this.sphere = header.sphere.map((part) => Float32Array.from(part));
    this.widths = { ...WIDTHS, shN: 3 * header.sh };
    this.before = {};
    this.after = {};
    this.total = {};
    this.moving = new Set(this.edits.flatMap((edit) => Object.keys(edit.attributes)));
    for (const name of this.moving) {
      for (const each of [name, PARTNERS[name]]) {
        if (!each || this.before[each]) continue;
        const width = this.widths[each], numbers = new Float32Array(this.count * width);
        container.attribute(each, 0, this.count, numbers, width);
        this.before[each] = numbers;
        this.after[each] = this.moving.has(each) ? numbers.slice() : numbers;
      }
      this.total[name] = new Float32Array(this.count * this.widths[name]);
    }
    this.marked = new Uint8Array(this.count);
    this.touched = new Uint8Array(this.count);
    this.meets = this.edits.map((a) => {
      this.marked.fill(0);
      for (const row of a.members) this.marked[row] = 1;
      return this.edits.map((b) => b.members.some((row) => this.marked[row]));
    });
    this.effects = this.edits.map(() => "");
    this.blend = "";
  }

  // Makes `after` the scene under layers { edit, strength, gains, weights, paint }, lowest first.
  // Gives the rows that changed, { first, last, names }, or null.
  update(layers, blend) {
    const active = layers.filter((layer) => layer.strength !== 0);
    const ordered = blend === "over" || blend === "adjust";
    const effects = this.edits.map((_, edit) => JSON.stringify(active.flatMap((layer, order) =>
      layer.edit === edit ? [[layer.strength, layer.gains, layer.paint, ordered ? order : 0]] : [])));
    const changed = [...effects.keys()].filter((edit) =>
      effects[edit] !== this.effects[edit] || (effects[edit] !== "[]" && blend !== this.blend));
    this.effects = effects;
    this.blend = blend;
    if (!changed.length) return null;
    const { marked } = this;
    marked.fill(0);
    let first = this.count, last = 0;
    for (const edit of changed) {
      const { members } = this.edits[edit];
      for (let i = 0; i < members.length; i++) marked[members[i]] = 1;
      if (members.length) {
        first = Math.min(first, members[0]);
        last = Math.max(last, members[members.length - 1] + 1);
      }
    }
    const near = this.edits.map((_, edit) => changed.some((other) => this.meets[edit][other]));
    const names = [...this.moving].filter((name) =>
      this.edits.some((edit, i) => near[i] && edit.attributes[name]));
    const stack = active.filter((layer) => near[layer.edit]);
    for (const name of names) this.total[name].fill(-0, first * this.widths[name], last * this.widths[name]);
    if (blend === "adjust") this.touched.fill(0);
    for (const layer of stack) this.#add(layer, names, blend);
    const divisors = blend === "normalized" ? this.#divisors(stack) : null;
    for (const name of names) this.#finish(name, first, last, divisors);
    return first < last ? { first, last, names } : null;
  }

  #add(layer, names, blend) {
    const edit = this.edits[layer.edit], { members } = edit, { weights } = layer, { marked, touched } = this;
    const held = Math.min(Math.max(layer.strength, 0), 1);
    const moved = names.filter((name) => edit.attributes[name] && layer.gains[KINDS[name]] !== 0);
    const colors = moved.filter((name) => KINDS[name] === "color");
    const maps = blend === "adjust" && edit.grade && colors.length > 0;
    const below = maps ? this.#gather(edit, colors) : null;
    for (const name of moved) {
      const kind = KINDS[name], gain = fround(layer.gains[kind]), width = this.widths[name];
      const total = this.total[name], used = edit.factors(name, layer.strength);
      const covered = blend === "over" || blend === "adjust" ? edit.coverage[kind] : null;
      const hidden = fround(held) * fround(Math.min(Math.abs(gain), 1));
      for (let i = 0; i < members.length; i++) {
        const row = members[i];
        if (!marked[row]) continue;
        const weight = weights ? weights[i] : 1;
        if (weight === 0) continue;
        const through = covered ? 1 - weight * hidden * covered[i] : 1, factor = weight * gain;
        for (let c = 0, to = row * width, from = i * width; c < width; c++, to++, from++) {
          let offset = 0;
          for (let k = 0; k < used.length; k++) offset += fround(used[k][1][c] * used[k][0][from]);
          total[to] = through * total[to] + factor * offset;
        }
      }
    }
    if (maps) this.#map(layer, edit, colors, below);
    if (blend === "adjust") {
      for (let i = 0; i < members.length; i++) if (!weights || weights[i]) touched[members[i]] = 1;
    }
  }

  // What lies below a grade where others have changed the color: members, and the sums of their bands.
  #gather(edit, colors) {
    const rows = [];
    edit.members.forEach((row, i) => { if (this.marked[row] && this.touched[row]) rows.push(i); });
    const width = colors.reduce((sum, name) => sum + this.widths[name], 0);
    const sums = new Float32Array(rows.length * width);
    rows.forEach((i, at) => {
      let to = at * width;
      for (const name of colors) {
        const w = this.widths[name], from = edit.members[i] * w;
        for (let c = 0; c < w; c++) sums[to++] = this.total[name][from + c];
      }
    });
    return { rows, width, sums };
  }

  #map(layer, edit, colors, { rows, width, sums }) {
    const sh = new Float32Array(width), change = new Float32Array(width), gain = layer.gains.color;
    const mapped = gradeChange(edit.grade, layer.strength, width / 3, this.sphere);
    rows.forEach((i, at) => {
      let to = 0;
      for (const name of colors) {
        const w = this.widths[name], from = edit.members[i] * w;
        for (let c = 0; c < w; c++, to++) sh[to] = this.before[name][from + c] + sums[at * width + to];
      }
      mapped(sh, i, change);
      const factor = (layer.weights ? layer.weights[i] : 1) * gain, share = edit.coverage.map[i];
      to = 0;
      for (const name of colors) {
        const w = this.widths[name], total = this.total[name], from = edit.members[i] * w;
        for (let c = 0; c < w; c++, to++) {
          const made = sums[at * width + to] + factor * change[to];
          total[from + c] += share * (made - total[from + c]);
        }
      }
    });
  }

  #divisors(stack) {
    if (stack.reduce((sum, layer) => sum + Math.min(layer.strength, 1), 0) <= 1 - 1e-6) return null;
    const sums = new Float32Array(this.count);
    for (const layer of stack) {
      const { members } = this.edits[layer.edit], held = fround(Math.min(Math.max(layer.strength, 0), 1));
      for (let i = 0; i < members.length; i++) sums[members[i]] += held * (layer.weights ? layer.weights[i] : 1);
    }
    return sums;
  }

  #finish(name, first, last, divisors) {
    const width = this.widths[name], total = this.total[name];
    const before = this.before[name], after = this.after[name], { marked } = this;
    for (let row = first; row < last; row++) {
      if (!marked[row]) continue;
      const divisor = divisors ? Math.max(divisors[row], 1) : 1;
      for (let j = row * width; j < (row + 1) * width; j++) after[j] = before[j] + fround(total[j] / divisor);
    }
  }
}
