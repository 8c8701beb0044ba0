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

// Gives a function that maps one color: rgb [3] -> rgb [3] in `out`.
function polynomial(table, degree) {
  const terms = new Float64Array(20);
  return (color, out) => {
    const [r, g, b] = color.map((x) => clamp(x, 0, MOST_COLOR));
    terms.set([1, r, g, b, r * r, g * g, b * b, r * g, g * b, b * r, r * r * r, g * g * g, b * b * b,
      r * r * g, r * r * b, g * g * r, g * g * b, b * b * r, b * b * g, r * g * b]);
    const count = [0, 4, 10, 20][degree];
    for (let c = 0; c < 3; c++) {
      let sum = 0;
      for (let k = 0; k < count; k++) sum += table[3 * k + c] * terms[k];
      out[c] = sum + Math.max(color[c] - MOST_COLOR, 0);
    }
  };
}

function lattice(table) {
  const side = Math.round(Math.cbrt(table.length / 3));
  return (color, out) => {
    const at = color.map((x) => clamp(x, 0, 1) * (side - 1));
    const low = at.map((x) => Math.min(Math.floor(x), side - 2));
    out.fill(0);
    for (let corner = 0; corner < 8; corner++) {
      let weight = 1, index = 0;
      for (let axis = 0; axis < 3; axis++) {
        const up = (corner >> axis) & 1, share = at[axis] - low[axis];
        weight *= up ? share : 1 - share;
        index += (low[axis] + up) * side ** axis;
      }
      for (let c = 0; c < 3; c++) out[c] += weight * table[3 * index + c];
    }
  };
}

// Spherical harmonics that show what the map makes of what they showed. sh, made: [B,3]
function mapBands(sh, bands, map, [values, inverse], made) {
  const color = [0, 0, 0], mapped = [0, 0, 0];
  if (bands === 1) {
    for (let c = 0; c < 3; c++) color[c] = sh[c] * C0 + 0.5;
    map(color, mapped);
    for (let c = 0; c < 3; c++) made[c] = mapped[c] <= 0 && color[c] <= 0 ? sh[c] : (mapped[c] - 0.5) / C0;
    return;
  }
  const directions = values.length / bands, target = new Float64Array(3 * directions);
  const clamped = [false, false, false];
  const seen = (numbers, d, c) => {
    let sum = 0.5;
    for (let b = 0; b < bands; b++) sum += numbers[3 * b + c] * values[d * bands + b];
    return sum;
  };
  const add = (d, c, missing) => {
    for (let b = 0; b < bands; b++) made[3 * b + c] += missing * inverse[b * directions + d];
  };
  made.set(sh);
  for (let d = 0; d < directions; d++) {
    for (let c = 0; c < 3; c++) color[c] = seen(sh, d, c);
    map(color, mapped);
    for (let c = 0; c < 3; c++) {
      target[3 * d + c] = mapped[c];
      clamped[c] ||= color[c] < 0 || mapped[c] < 0;
      add(d, c, mapped[c] - Math.max(color[c], 0));
    }
  }
  for (let c = 0; c < 3; c++) {
    if (!clamped[c]) continue;
    const now = Array.from({ length: directions }, (_, d) => seen(made, d, c));
    now.forEach((shown, d) => {
      if (target[3 * d + c] > 0 || shown > 0) add(d, c, target[3 * d + c] - shown);
    });
  }
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
  const made = new Float64Array(3 * bands), width = grade.scale[0]?.length ?? 0;
  return (sh, member, change) => {
    mapBands(sh, bands, map, sphere, made);
    const part = (straight ? share : 1) * (grade.share ? grade.share[member] : 1);
    for (let j = 0; j < change.length; j++) change[j] = part * (made[j] - sh[j]);
    grade.residual.forEach((basis, k) => {
      for (let j = 0; j < width; j++) change[j] += basis[member * width + j] * row[k] * grade.scale[k][j];
    });
  };
}
