// Depth order, exact in float32: a two-pass radix sort, in a worker for large scenes.

const LARGE = 150_000;  // Gaussians above which sorting would delay frames

// Writes the rows in front of the near plane into `order`, farthest first; returns their number.
// row: 4 numbers of the view matrix.
function backToFront(means, row, near, order, scratch) {
  const [a, b, c, d] = row, count = means.length / 3;
  const { depths, bits, rows, between, low, high } = scratch;
  low.fill(0);
  high.fill(0);
  let seen = 0;
  for (let i = 0, at = 0; i < count; i++, at += 3) {
    const depth = means[at] * a + means[at + 1] * b + means[at + 2] * c + d;
    if (!(depth > near && depth < Infinity)) continue;
    depths[seen] = depth;
    rows[seen] = i;
    const key = bits[seen];  // positive floats sort like their bits
    low[key & 0xffff]++;
    high[key >>> 16]++;
    seen++;
  }
  for (let key = 0xffff, l = 0, h = 0; key >= 0; key--) {  // start index of each key, the largest key first
    const [ofLow, ofHigh] = [low[key], high[key]];
    low[key] = l;
    high[key] = h;
    l += ofLow;
    h += ofHigh;
  }
  for (let i = seen - 1; i >= 0; i--) between[low[bits[i] & 0xffff]++] = i;
  for (let i = 0; i < seen; i++) order[high[bits[between[i]] >>> 16]++] = rows[between[i]];
  return seen;
}

function makeScratch(count) {
  const depths = new Float32Array(count);
  return {
    depths, bits: new Uint32Array(depths.buffer), rows: new Uint32Array(count), between: new Uint32Array(count),
    low: new Uint32Array(65536), high: new Uint32Array(65536),
  };
}

// The worker's program.
function serve() {
  let means, scratch;
  self.onmessage = ({ data }) => {
    if (data.all) {
      means = data.all;
      scratch = makeScratch(means.length / 3);
    } else if (data.moved) means.set(data.moved, data.at);
    else {
      const seen = backToFront(means, data.row, data.near, data.order, scratch);
      self.postMessage({ order: data.order, seen, row: data.row }, [data.order.buffer]);
    }
  };
}

function startWorker() {
  const source = `${backToFront};${makeScratch};(${serve})()`;
  const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
  try {
    return new Worker(url);
  } catch {  // a content security policy without blob workers
    return null;
  } finally {
    URL.revokeObjectURL(url);
  }
}

// Sorts rows of `means`; calls `done(order, seen)` with the rows to draw, at once or later.
export class Sorter {
  constructor(means, near, done) {
    this.means = means;
    this.near = near;
    this.done = done;
    this.order = new Uint32Array(means.length / 3);
    this.worker = this.order.length > LARGE ? startWorker() : null;
    if (!this.worker) return void (this.scratch = makeScratch(this.order.length));
    this.worker.onerror = (event) => {  // blocked after its creation
      event.preventDefault();
      this.worker = null;
      this.order = new Uint32Array(means.length / 3);
      this.scratch = makeScratch(means.length / 3);
      if (this.latest) this.sort(this.latest);
    };
    this.worker.onmessage = ({ data }) => {
      this.order = data.order;
      this.done(data.order, data.seen);
      const next = this.wanted;
      this.wanted = null;
      if (next) this.sort(next);
    };
    this.worker.postMessage({ all: means });
  }

  // Receives rows whose centers have changed.
  moved(first, last) {
    this.worker?.postMessage({ moved: this.means.slice(3 * first, 3 * last), at: 3 * first });
  }

  sort(row) {
    this.latest = row;
    if (!this.worker) this.done(this.order, backToFront(this.means, row, this.near, this.order, this.scratch));
    else if (!this.order) this.wanted = row;
    else {
      const { order } = this;
      this.order = null;
      this.worker.postMessage({ row, near: this.near, order }, [order.buffer]);
    }
  }
}
