// What a grade makes of colors that others have changed: progdf/field/grade.py, adjust_colors.

import { findSegment } from "./compose.js";

const C0 = 0.28209479177387814;
const MOST_COLOR = 1.5;
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

function interpolate(x, knots, values) {
  let right = 1;
  while (right < knots.length - 1 && knots[right] < x) right++;
  const share = clamp((x - knots[right - 1]) / (knots[right] - knots[right - 1]), 0, 1);
  return values[right - 1] + share * (values[right] - values[right - 1]);
}

// Gives a function that maps one color: (r, g, b, out [3]).
function polynomial(t, degree) {
  return (red, green, blue, out) => {
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
      out[c] = sum;
    }
    if (red > MOST_COLOR) out[0] += red - MOST_COLOR;
    if (green > MOST_COLOR) out[1] += green - MOST_COLOR;
    if (blue > MOST_COLOR) out[2] += blue - MOST_COLOR;
  };
}

function lattice(table) {
  const side = Math.round(Math.cbrt(table.length / 3)), at = new Float64Array(3), low = new Int32Array(3);
  return (red, green, blue, out) => {
    at[0] = clamp(red, 0, 1) * (side - 1);
    at[1] = clamp(green, 0, 1) * (side - 1);
    at[2] = clamp(blue, 0, 1) * (side - 1);
    for (let axis = 0; axis < 3; axis++) {
      low[axis] = Math.min(Math.floor(at[axis]), side - 2);
      at[axis] -= low[axis];
    }
    out.fill(0);
    for (let corner = 0; corner < 8; corner++) {
      const [r, g, b] = [corner & 1, (corner >> 1) & 1, corner >> 2];
      const weight = (r ? at[0] : 1 - at[0]) * (g ? at[1] : 1 - at[1]) * (b ? at[2] : 1 - at[2]);
      const index = 3 * (low[0] + r + side * (low[1] + g + side * (low[2] + b)));
      for (let c = 0; c < 3; c++) out[c] += weight * table[index + c];
    }
  };
}

// Gives a function (sh, made [B,3]): harmonics that show what the map makes of what they showed.
function bandMapper(bands, map, [values, inverse]) {
  const mapped = new Float64Array(3);
  if (bands === 1) {
    return (sh, made) => {
      map(sh[0] * C0 + 0.5, sh[1] * C0 + 0.5, sh[2] * C0 + 0.5, mapped);
      for (let c = 0; c < 3; c++) {
        made[c] = mapped[c] <= 0 && sh[c] * C0 + 0.5 <= 0 ? sh[c] : (mapped[c] - 0.5) / C0;
      }
    };
  }
  const directions = values.length / bands, target = new Float64Array(3 * directions);
  const color = new Float64Array(3 * directions), clamped = new Uint8Array(3);
  const show = (sh, c) => {
    for (let d = 0; d < directions; d++) {
      let sum = 0.5;
      for (let b = 0; b < bands; b++) sum += sh[3 * b + c] * values[d * bands + b];
      color[3 * d + c] = sum;
    }
  };
  const add = (made, c, missing) => {  // least squares: missing [D,3]
    for (let b = 0; b < bands; b++) {
      let sum = 0;
      for (let d = 0; d < directions; d++) sum += missing[3 * d + c] * inverse[b * directions + d];
      made[3 * b + c] += sum;
    }
  };
  return (sh, made) => {
    made.set(sh);
    clamped.fill(0);
    for (let c = 0; c < 3; c++) show(sh, c);
    for (let d = 0; d < 3 * directions; d += 3) {
      map(color[d], color[d + 1], color[d + 2], mapped);
      for (let c = 0; c < 3; c++) {
        target[d + c] = mapped[c];
        if (color[d + c] < 0 || mapped[c] < 0) clamped[c] = 1;
        color[d + c] = mapped[c] - Math.max(color[d + c], 0);
      }
    }
    for (let c = 0; c < 3; c++) add(made, c, color);
    for (let c = 0; c < 3; c++) {
      if (!clamped[c]) continue;
      show(made, c);
      for (let j = c; j < color.length; j += 3) {
        color[j] = target[j] <= 0 && color[j] <= 0 ? 0 : target[j] - color[j];
      }
      add(made, c, color);
    }
  };
}

// Gives a function (sh [B,3], member, change) of a grade at a strength, which writes what it adds to the bands.
export function gradeChange(grade, strength, bands, sphere) {
  const at = strength < 1 ? interpolate(strength, grade.new, grade.old) : strength;
  const [right, share] = findSegment(grade.knots, at);
  const low = grade.table[right - 1], high = grade.table[right];
  const straight = grade.degree === 0;
  const table = straight || share === 1 ? high : high.map((x, k) => low[k] + share * (x - low[k]));
  const map = straight ? lattice(table) : polynomial(table, grade.degree);
  const row = grade.coefficients[right].map((x, k) => {
    const from = grade.coefficients[right - 1][k];
    return from + share * (x - from);
  });
  const remap = bandMapper(bands, map, sphere), made = new Float64Array(3 * bands);
  const width = grade.scale[0]?.length ?? 0, factors = grade.scale.map((units, k) => units.map((unit) => unit * row[k]));
  return (sh, member, change) => {
    remap(sh, made);
    const part = (straight ? share : 1) * (grade.share ? grade.share[member] : 1);
    for (let j = 0; j < change.length; j++) change[j] = part * (made[j] - sh[j]);
    for (let k = 0; k < factors.length; k++) {
      const basis = grade.residual[k], units = factors[k];
      for (let j = 0; j < width; j++) change[j] += basis[member * width + j] * units[j];
    }
  };
}
