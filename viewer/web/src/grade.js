// A grade applied to colors that other layers have changed: progdf/field/grade.py, adjust_colors.

const C0 = 0.28209479177387814;
const MOST_COLOR = 1.5;
const clamp = (x, low, high) => (x > low ? (x < high ? x : high) : low);  // faster than Math.min and Math.max

// Returns the segment of ascending knots that contains x: the index of its right knot, and the share of x in it.
export function findSegment(knots, x) {
  const at = Math.fround(x);
  let right = 1;
  while (right < knots.length - 1 && knots[right] < at) right++;
  return [right, (x - knots[right - 1]) / (knots[right] - knots[right - 1])];
}

function interpolate(x, knots, values) {
  let right = 1;
  while (right < knots.length - 1 && knots[right] < x) right++;
  const share = clamp((x - knots[right - 1]) / (knots[right] - knots[right - 1]), 0, 1);
  return values[right - 1] + share * (values[right] - values[right - 1]);
}

const lerpAll = (low, high, share) => high.map((x, k) => (share === 1 ? x : low[k] + share * (x - low[k])));

// Maps colors [D,3] by a polynomial.
function polynomial(colors, out, t, degree) {
  for (let d = 0; d < out.length; d += 3) {
    const red = colors[d], green = colors[d + 1], blue = colors[d + 2];
    const r = clamp(red, 0, MOST_COLOR), g = clamp(green, 0, MOST_COLOR), b = clamp(blue, 0, MOST_COLOR);
    const rr = r * r, gg = g * g, bb = b * b, rg = r * g, gb = g * b, br = b * r;
    for (let c = 0; c < 3; c++) {
      let sum = t[c] + t[3 + c] * r + t[6 + c] * g + t[9 + c] * b;
      if (degree > 1) {
        sum += t[12 + c] * rr + t[15 + c] * gg + t[18 + c] * bb + t[21 + c] * rg + t[24 + c] * gb + t[27 + c] * br;
      }
      if (degree > 2) {
        sum += t[30 + c] * rr * r + t[33 + c] * gg * g + t[36 + c] * bb * b + t[39 + c] * rr * g + t[42 + c] * rr * b;
        sum += t[45 + c] * gg * r + t[48 + c] * gg * b + t[51 + c] * bb * r + t[54 + c] * bb * g + t[57 + c] * rg * b;
      }
      out[d + c] = colors[d + c] > MOST_COLOR ? sum + colors[d + c] - MOST_COLOR : sum;
    }
  }
}

function lattice(colors, out, table) {
  const side = Math.round(Math.cbrt(table.length / 3)), at = [0, 0, 0], low = [0, 0, 0];
  out.fill(0);
  for (let d = 0; d < out.length; d += 3) {
    for (let axis = 0; axis < 3; axis++) {
      at[axis] = clamp(colors[d + axis], 0, 1) * (side - 1);
      low[axis] = Math.min(Math.floor(at[axis]), side - 2);
      at[axis] -= low[axis];
    }
    for (let corner = 0; corner < 8; corner++) {
      const r = corner & 1, g = (corner >> 1) & 1, b = corner >> 2;
      const weight = (r ? at[0] : 1 - at[0]) * (g ? at[1] : 1 - at[1]) * (b ? at[2] : 1 - at[2]);
      const index = 3 * (low[0] + r + side * (low[1] + g + side * (low[2] + b)));
      for (let c = 0; c < 3; c++) out[d + c] += weight * table[index + c];
    }
  }
}

// The change that a grade makes to the bands sh [m,B,3] of some of its members. The map is linear in its table, so
// between two knots it interpolates linearly, except for members that are black from some direction.
export class GradedColors {
  constructor(grade, [values, inverse], sh, members) {
    const bands = sh.length / 3 / members.length, directions = bands > 1 ? values.length / bands : 1;
    Object.assign(this, { grade, sh, members, bands, directions, values: Float64Array.from(values), knots: null });
    this.inverse = Float64Array.from(inverse);
    this.color = new Float64Array(3 * directions);
    this.target = new Float64Array(3 * directions);
    this.made = new Float64Array(3 * bands);
    this.change = new Float32Array(sh.length);
  }

  // Returns the change at a strength, [m,B,3], valid until the next call. The first call caches no knots, as the
  // layers below may be moving. `color`, `texture`: gains; `mean`: share of the map that is color.
  at(strength, color, texture, mean = 1) {
    const { grade, change, sh, members } = this, straight = grade.degree === 0;
    const at = strength < 1 ? interpolate(strength, grade.new, grade.old) : strength;
    const [right, share] = findSegment(grade.knots, at), width = 3 * this.bands;
    const low = grade.table[right - 1], high = grade.table[right];
    const table = straight ? high : lerpAll(low, high, share);
    if (this.bands === 1 || !this.knots || share > 1 && !straight) {
      this.knots ??= [];
      for (let i = 0; i < members.length; i++) this.#map(table, i, change);
    } else {
      const ends = [straight || right === 1 ? null : this.#knot(right - 1), this.#knot(right)];
      this.knots = this.knots.map((knot) => (ends.includes(knot) ? knot : null));
      const [from, to] = ends, part = straight ? 1 : share;
      if (from) for (let j = 0; j < sh.length; j++) change[j] = from.change[j] + part * (to.change[j] - from.change[j]);
      else for (let j = 0; j < sh.length; j++) change[j] = part * to.change[j];
      for (let i = 0; i < members.length; i++) if (to.black[i] || from?.black[i]) this.#map(table, i, change);
    }
    if (straight || grade.share || color !== 1 || texture !== 1) {
      for (let i = 0, j = 0; i < members.length; i++) {
        const own = texture * (grade.share ? grade.share[members[i]] : 1) + (color - texture) * mean;
        const part = (straight ? share : 1) * own;
        for (const end = j + width; j < end; j++) change[j] *= part;
      }
    }
    const row = lerpAll(grade.coefficients[right - 1], grade.coefficients[right], share);
    grade.residual.forEach((basis, k) => {
      const units = Float64Array.from(grade.scale[k], (unit) => texture * unit * row[k]), own = units.length;
      for (let i = 0; i < members.length; i++) {
        for (let c = 0, j = i * width, from = members[i] * own; c < own; c++) change[j + c] += basis[from + c] * units[c];
      }
    });
    return change;
  }

  #knot(k) {
    if (!this.knots[k]) {
      const change = new Float32Array(this.sh.length), black = new Uint8Array(this.members.length);
      for (let i = 0; i < black.length; i++) black[i] = this.#map(this.grade.table[k], i, change, true);
      this.knots[k] = { change, black };
    }
    return this.knots[k];
  }

  // Computes the change of a member and returns its black channels as a mask; `once`: skip the correction of black.
  #map(table, member, change, once = false) {
    const { sh, bands, directions, made, color, target, inverse } = this, first = 3 * bands * member;
    for (let j = 0; j < made.length; j++) made[j] = sh[first + j];
    const map = this.grade.degree === 0 ? lattice : polynomial;
    if (bands === 1) {
      for (let c = 0; c < 3; c++) color[c] = made[c] * C0 + 0.5;
      map(color, target, table, this.grade.degree);
      for (let c = 0; c < 3; c++) {
        change[first + c] = target[c] <= 0 && color[c] <= 0 ? 0 : (target[c] - 0.5) / C0 - made[c];
      }
      return 0;
    }
    this.#show();
    map(color, target, table, this.grade.degree);
    let black = 0;
    for (let d = 0; d < color.length; d += 3) {
      for (let c = 0; c < 3; c++) {
        const x = color[d + c], y = target[d + c];
        if (x < 0 || y < 0) black |= 1 << c;
        color[d + c] = x > 0 ? y - x : y;
      }
    }
    this.#project(7);
    if (black && !once) {
      this.#show();
      for (let j = 0; j < color.length; j++) color[j] = target[j] <= 0 && color[j] <= 0 ? 0 : target[j] - color[j];
      this.#project(black);
    }
    for (let j = 0; j < made.length; j++) change[first + j] = made[j] - sh[first + j];
    return black;
  }

  // Evaluates the colors of `made` in all directions.
  #show() {
    const { bands, made, color, values } = this;
    for (let at = 0, to = 0; to < color.length; to += 3) {
      let r = 0.5, g = 0.5, b = 0.5;
      for (let j = 0; j < made.length; j += 3, at++) {
        const value = values[at];
        r += made[j] * value;
        g += made[j + 1] * value;
        b += made[j + 2] * value;
      }
      color[to] = r;
      color[to + 1] = g;
      color[to + 2] = b;
    }
  }

  // Adds the residual `color` to `made` by least squares, in the channels of a mask.
  #project(channels) {
    const { made, color, inverse } = this, red = channels & 1, green = (channels >> 1) & 1, blue = channels >> 2;
    for (let at = 0, to = 0; to < made.length; to += 3) {
      let r = 0, g = 0, b = 0;
      for (let j = 0; j < color.length; j += 3, at++) {
        const value = inverse[at];
        r += color[j] * value;
        g += color[j + 1] * value;
        b += color[j + 2] * value;
      }
      made[to] += red * r;
      made[to + 1] += green * g;
      made[to + 2] += blue * b;
    }
  }
}
