// The scene under a stack of edits, members only; same results as progdf/compose/reference.py. Rows of the same
// edits are adjacent and composed together, as a segment.

import { FOLLOWED, Surface } from "./follow.js";
import { MOVED, Carrier } from "./moves.js";
import { ARRANGED, PaintOrder } from "./paint.js";
import { GradedColors, findSegment } from "./grade.js";

export const WIDTHS = { means: 3, log_scales: 3, quats: 4, logit_opacities: 1, sh0: 3 };
export const KINDS = {
  means: "geometry", log_scales: "geometry", quats: "geometry",
  logit_opacities: "opacity", sh0: "color", shN: "color",
};
const PARTNERS = { means: "logit_opacities", logit_opacities: "means" };  // attributes that share a texture
const { fround } = Math;

class Edit {
  constructor(container, record) {
    const read = (part) => part.map((row) => Float32Array.from(row));
    const readAll = (parts) => Object.fromEntries(Object.entries(parts).map(([name, bases]) => [name, {
      stored: [bases.end, ...bases.residual].map((part) => container.stored(part)),
      scale: read(bases.scale),
      coefficients: read(bases.coefficients),
    }]));
    this.name = record.name;
    this.recorded = record.recorded;
    this.knots = Float32Array.from(record.knots);
    this.attributes = readAll(record.attributes);
    // Color apart from texture, see progdf/gdf/texture.py; null if no layer needs it or the edit has no texture.
    this.split = record.split && {
      bases: readAll(record.split.color),
      mapShare: record.split.map_share,
      discs: record.split.discs?.map((part) => container.real(part)),
    };
    this.kinds = new Set(Object.keys(record.attributes).map((name) => KINDS[name]));
    this.pushes = new Set(record.pushes);  // kinds of change that make way for paint
    this.leavesPaint = record.leaves_paint;  // it moves or removes rows without their paint
    this.coverage = {};
    for (const [kind, part] of Object.entries(record.coverage ?? {})) this.coverage[kind] = container.real(part);
    this.grade = record.grade && {
      ...record.grade,
      table: record.grade.table.map((part) => container.real(part)),
      residual: record.grade.residual.map((part) => container.stored(part)),
      share: record.grade.share && container.real(record.grade.share),
    };
  }

  // Returns the factors of the edit's offsets of a kind, and of their color part.
  factors(kind, gains) {
    if (kind !== "color" || !this.split) return [gains[kind], 0];
    return [gains.texture, this.split.bases.sh0 ? gains.color - gains.texture : 0];
  }

  // Returns whether gains leave a kind of change.
  moves(kind, gains) {
    return this.factors(kind, gains).some((factor) => factor !== 0);
  }

  // Computes offsets of an attribute from `first` on; returns their factor. `scratch`: two arrays of the same size.
  weighted(name, { strength, gains }, first, out, scratch) {
    const [factor, part] = this.factors(KINDS[name], gains), color = part && this.split.bases[name];
    this.offsets(this.attributes[name], strength, first, out, scratch[0]);
    if (!color) return fround(factor);
    this.offsets(color, strength, first, scratch[1], scratch[0]);
    for (let j = 0; j < out.length; j++) out[j] = factor * out[j] + part * scratch[1][j];
    return 1;
  }

  // Computes offsets from bases from `first` on. `levels`: scratch of the same size, for the bases.
  offsets({ stored, scale, coefficients }, strength, first, out, levels) {
    const [right, share] = findSegment(this.knots, strength);
    const low = coefficients[right - 1], high = coefficients[right];
    out.fill(-0);
    stored.forEach((numbers, k) => {
      const a = share === 1 ? high[k] : fround(low[k] + fround(share) * (high[k] - low[k]));
      if (a === 0) return;
      levels.set(numbers.subarray(first, first + out.length));  // a single type keeps the loop fast
      const factors = Float64Array.from(scale[k], (unit) => a * unit), width = factors.length;
      for (let j = 0; j < out.length;) for (let c = 0; c < width; c++, j++) out[j] += fround(factors[c] * levels[j]);
    });
  }
}

export class Composer {
  constructor(container) {
    const { header } = container;
    this.count = header.members;
    this.edits = header.edits.map((record) => new Edit(container, record));
    this.sphere = header.sphere;
    this.widths = { ...WIDTHS, shN: 3 * header.sh };
    this.before = {};
    this.after = {};
    this.moving = new Set(this.edits.flatMap((edit) => Object.keys(edit.attributes)));
    const follows = header.surface || (header.followers && header.attributes.means);
    const followed = header.surface?.banded && header.sh ? [...FOLLOWED, "shN"] : FOLLOWED;
    for (const name of follows ? followed : []) this.moving.add(name);
    for (const name of header.paint ? ARRANGED : []) this.moving.add(name);
    const composed = new Set(this.moving), moves = header.moves?.length ? header.moves : null;
    for (const name of moves ? MOVED : []) if (this.widths[name]) this.moving.add(name);
    if (this.edits.some((edit) => edit.split?.discs)) this.moving.add("sh0");
    for (const name of this.moving) {
      for (const each of [name, PARTNERS[name]]) {
        if (!each || this.before[each]) continue;
        const width = this.widths[each], numbers = new Float32Array(this.count * width);
        container.attribute(each, 0, this.count, numbers, width);
        this.before[each] = numbers;
        this.after[each] = this.moving.has(each) ? numbers.slice() : numbers;
      }
    }
    this.below = { ...this.after };  // before the moves
    for (const name of moves ? MOVED : []) if (this.after[name]) this.after[name] = this.below[name].slice();
    const known = this.edits.map(() => 0);  // members of the previous segments
    let first = 0, most = 0;
    const states = header.surface && new Composer(container.within(header.surface));
    this.surface = states && new Surface(header.surface, container, states, Math.sqrt(header.sh + 1) - 1, this.sphere[1]);
    const tints = header.paint?.tints && new Composer(container.within(header.paint.tints));
    this.paint = header.paint ? new PaintOrder(header.paint, container, tints) : null;
    const following = Array.from({ length: this.surface?.count ?? 0 }, (_, f) => f);
    this.segments = header.segments.map(([rows, edits]) => {
      const followers = following.filter((f) => this.surface.row(f) >= first && this.surface.row(f) < first + rows);
      const paints = this.paint?.touches(first, rows);
      const names = [...composed].filter((name) =>
        (paints && ARRANGED.includes(name)) || (followers.length && followed.includes(name)) ||
        (name === "sh0" && edits.some((edit) => this.edits[edit].split?.discs)) ||
        edits.some((edit) => this.edits[edit].attributes[name]));
      const segment = { first, rows, names, followers, paints, members: {}, effects: [], maps: [] };
      for (const edit of edits) {
        segment.members[edit] = known[edit];
        known[edit] += rows;
      }
      first += rows;
      most = Math.max(most, ...names.map((name) => rows * this.widths[name]));
      return segment;
    });
    this.carrier = moves && new Carrier(moves, moves.map(({ field }) => new Edit(container, field)), container, this);
    this.scratch = [new Float32Array(most), new Float32Array(most), new Float32Array(most)];
    this.blend = "";
  }

  // Updates `after` to the scene under layers { edit, strength, gains, weights, paint }, lowest first.
  // Returns the change { ranges [first, last], names }, or null.
  update(layers, blend) {
    const active = layers.filter((layer) => layer.strength !== 0).map((layer) =>
      ({ ...layer, effect: JSON.stringify([layer.edit, layer.strength, layer.gains, layer.paint, layer.blend]) }));
    const ranges = [], names = new Set(), again = blend !== this.blend;
    this.blend = blend;
    const surfaceMoved = this.surface?.update(active, blend), paintMoved = this.paint?.update(active, blend);
    const redone = [], movesChanged = this.carrier?.update(active);
    for (const segment of this.segments) {
      const stack = active.filter((layer) => layer.edit in segment.members), { effects, first, rows } = segment;
      let same = 0;
      const mixed = this.#averagedAlone(stack);  // then each average depends on all layers
      if (!again && !mixed) while (same < stack.length && stack[same].effect === effects[same]) same++;
      const depends = (surfaceMoved && segment.followers.length) || (paintMoved && segment.paints) ||
        (movesChanged && this.carrier.touches(segment));
      if (same === stack.length && same === effects.length && !depends) continue;
      this.#compose(segment, stack, same);
      redone.push(segment);
      segment.effects = stack.map((layer) => layer.effect);
      for (const name of this.carrier?.touches(segment) ? this.moving : segment.names) names.add(name);
      if (ranges.at(-1)?.[1] === first) ranges.at(-1)[1] = first + rows;
      else ranges.push([first, first + rows]);
    }
    this.paint?.arrange(this.below, redone);
    for (const { followers } of redone) for (const f of followers) this.surface.carry(this.below, f);
    for (const segment of redone) this.carrier?.carry(segment);
    return ranges.length ? { ranges, names: [...names] } : null;
  }

  // Caches the sum of the `same` layers below the lowest changed one for the next call.
  #compose(segment, stack, same) {
    const { first, rows, names } = segment, totals = {};
    const kept = segment.below?.at === same ? segment.below : null;
    segment.below = kept;
    for (const name of names) {
      const width = this.widths[name];
      totals[name] = this.below[name].subarray(first * width, (first + rows) * width);
      if (kept) totals[name].set(kept.totals[name]);
      else totals[name].fill(-0);
    }
    for (let at = kept ? same : 0; at < stack.length; at++) {
      if (at === same && at > 0 && !kept) {
        segment.below = { at, totals: Object.fromEntries(names.map((name) => [name, totals[name].slice()])) };
      }
      this.#add(segment, stack, at, totals);
    }
    const shares = !this.#averagedAlone(stack) && stack.some((layer) => this.#rule(layer) === "normalized"), sums = {};
    for (const name of names) {
      const kind = KINDS[name];
      if (shares && !(kind in sums)) sums[kind] = this.#divisors(segment, stack, kind);
      const divisors = sums[kind], width = this.widths[name], total = totals[name];
      const before = this.before[name].subarray(first * width, (first + rows) * width);
      if (divisors) for (let j = 0; j < total.length; j++) total[j] /= divisors[Math.floor(j / width)];
      this.#push(segment, stack, name, total);
      for (let j = 0; j < total.length; j++) total[j] += before[j];
    }
    if (totals.sh0) this.#colorDiscs(segment, stack, totals.sh0);
  }

  #rule(layer) {
    return layer.blend || this.blend;
  }

  // Returns whether averaged layers lie among layers with another rule, and are averaged by themselves.
  #averagedAlone(stack) {
    const rules = new Set(stack.map((layer) => this.#rule(layer)));
    return rules.has("normalized") && rules.size > 1;
  }

  // Changes the colors of painted discs by the gains of their layers; of two layers of one edit, the stronger one shows.
  #colorDiscs({ rows, members }, stack, total) {
    const opacity = (layer) => clampedStrength(layer) * Math.min(Math.abs(layer.gains.opacity), 1);
    for (const layer of stack) {
      const [change, color] = this.edits[layer.edit].split?.discs ?? [], { gains } = layer;
      const own = stack.filter(({ edit }) => edit === layer.edit);
      if (!change || own.findLast((each) => own.every((one) => opacity(one) <= opacity(each))) !== layer) continue;
      for (let j = 0, at = 3 * members[layer.edit]; j < 3 * rows; j++, at++) {
        total[j] += (gains.texture - 1) * change[at] + (gains.color - gains.texture) * color[at];
      }
    }
  }

  // Adds the largest change by which a layer makes way for its paint.
  #push(segment, stack, name, total) {
    const { rows } = segment, width = this.widths[name], kind = KINDS[name];
    const pushing = stack.filter(({ edit, gains }) =>
      this.edits[edit].pushes.has(kind) && this.edits[edit].attributes[name] && this.edits[edit].moves(kind, gains));
    if (!pushing.length) return;
    const largest = new Float32Array(total.length).fill(-0);
    const [offsets, ...scratch] = this.scratch.map((numbers) => numbers.subarray(0, rows * width));
    for (const layer of pushing) {
      const member = segment.members[layer.edit];
      const gain = this.edits[layer.edit].weighted(name, layer, member * width, offsets, scratch);
      for (let i = 0; i < rows; i++) {
        const factor = (layer.weights ? layer.weights[member + i] : 1) * gain;
        let before = 0, now = 0;
        for (let j = i * width; j < (i + 1) * width; j++) {
          offsets[j] *= factor;
          now += offsets[j] ** 2;
          before += largest[j] ** 2;
        }
        if (now >= before) for (let j = i * width; j < (i + 1) * width; j++) largest[j] = offsets[j];
      }
    }
    for (const layer of stack.filter(({ edit }) => this.edits[edit].leavesPaint)) {
      const held = clampedStrength(layer), member = segment.members[layer.edit];
      const weight = (j) => layer.weights?.[member + Math.floor(j / width)] ?? 1;
      for (let j = 0; j < total.length; j++) largest[j] *= 1 - held * weight(j);
    }
    for (let j = 0; j < total.length; j++) total[j] += largest[j];
  }

  #add(segment, stack, at, totals) {
    const layer = stack[at], edit = this.edits[layer.edit], member = segment.members[layer.edit], { rows } = segment;
    const { weights } = layer, held = clampedStrength(layer);
    const moved = segment.names.filter((name) =>
      edit.attributes[name] && edit.moves(KINDS[name], layer.gains) && !edit.pushes.has(KINDS[name]));
    const colors = moved.filter((name) => KINDS[name] === "color");
    const rule = this.#rule(layer), hides = at > 0 && (rule === "over" || rule === "adjust");
    const averaged = rule === "normalized" && this.#averagedAlone(stack);
    const map = hides && rule === "adjust" && edit.grade && colors.length
      ? this.#graded(segment, stack, at, colors, totals) : null;
    for (const name of moved) {
      const kind = KINDS[name], width = this.widths[name], total = totals[name];
      const [offsets, ...scratch] = this.scratch.map((numbers) => numbers.subarray(0, rows * width));
      const gain = edit.weighted(name, layer, member * width, offsets, scratch);
      const covered = hides ? edit.coverage[kind].subarray(member, member + rows) : null;
      const hidden = held * fround(Math.min(Math.abs(layer.gains[kind]), 1));
      const divisors = averaged ? this.#divisors(segment, stack, kind) : null;
      if (!weights && !covered && !divisors) for (let j = 0; j < total.length; j++) total[j] += gain * offsets[j];
      else {
        for (let i = 0, j = 0; i < rows; i++) {
          const weight = weights ? weights[member + i] : 1, end = j + width;
          const factor = weight * gain / (divisors ? divisors[i] : 1);
          const through = covered ? 1 - weight * hidden * covered[i] : 1;
          if (weight === 0) j = end;
          for (; j < end; j++) total[j] = through * total[j] + factor * offsets[j];
        }
      }
    }
    if (map) this.#adjust(layer, edit, member, colors, totals, map);
  }

  // Prepares a grade above other layers: the rows that they changed, their summed bands, and the graded colors.
  #graded(segment, stack, at, colors, totals) {
    const layer = stack[at], edit = this.edits[layer.edit], { first } = segment;
    const below = stack.slice(0, at).filter((each) => !this.edits[each.edit].pushes.has("color"));
    const key = [...below.map((each) => each.effect), JSON.stringify(layer.paint), ...colors].join();
    if (segment.maps[at]?.key === key && segment.maps[at].edit === edit) return segment.maps[at];
    const weightOf = (each, i) => each.weights?.[segment.members[each.edit] + i] ?? 1, rows = [];
    for (let i = 0; i < segment.rows; i++) {
      if (weightOf(layer, i) !== 0 && below.some((each) => weightOf(each, i) !== 0)) rows.push(i);
    }
    const width = colors.reduce((sum, name) => sum + this.widths[name], 0);
    const sums = new Float32Array(rows.length * width), sh = new Float32Array(sums.length);
    let to = 0;
    for (const i of rows) {
      for (const name of colors) {
        const w = this.widths[name];
        for (let c = 0; c < w; c++, to++) {
          sums[to] = totals[name][i * w + c];
          sh[to] = this.before[name][(first + i) * w + c] + sums[to];
        }
      }
    }
    const members = Int32Array.from(rows, (i) => segment.members[layer.edit] + i);
    const graded = new GradedColors(edit.grade, this.sphere, sh, members);
    return (segment.maps[at] = { key, edit, rows, width, sums, graded });
  }

  #adjust(layer, edit, member, colors, totals, { rows, width, sums, graded }) {
    const { color, texture } = layer.gains, { split } = edit;
    const change = graded.at(layer.strength, color, split ? texture : color, split?.mapShare);
    let from = 0;
    for (const name of colors) {
      const w = this.widths[name], total = totals[name];
      for (let k = 0; k < rows.length; k++) {
        const i = rows[k], factor = layer.weights ? layer.weights[member + i] : 1;
        const share = edit.coverage.map[member + i];
        for (let c = 0, j = i * w, at = k * width + from; c < w; c++, j++, at++) {
          total[j] += share * (sums[at] + factor * change[at] - total[j]);
        }
      }
      from += w;
    }
  }

  // Returns max(1, Σ m s) over the layers with this kind of change; null if it is 1 everywhere.
  #divisors({ rows, members }, all, kind) {
    const stack = all.filter((layer) => this.#rule(layer) === "normalized" &&
      this.edits[layer.edit].kinds.has(kind) && !this.edits[layer.edit].pushes.has(kind));
    if (stack.reduce((sum, layer) => sum + clampedStrength(layer), 0) <= 1 - 1e-6) return null;
    const sums = new Float32Array(rows);
    for (const layer of stack) {
      const held = clampedStrength(layer), member = members[layer.edit];
      for (let i = 0; i < rows; i++) sums[i] += held * (layer.weights ? layer.weights[member + i] : 1);
    }
    return sums.map((sum) => Math.max(sum, 1));
  }
}

const clampedStrength = (layer) => fround(Math.min(Math.max(layer.strength, 0), 1));
