// Reader of the container written by viewer/web/page.py: a header, and arrays of numbers.

const BYTES = { f4: 4, i4: 4, i2: 2, i1: 1 };
const TYPED = { f4: Float32Array, i4: Int32Array, i2: Int16Array, i1: Int8Array };
const word = new Uint32Array(1), real = new Float32Array(word.buffer);

// Decodes and decompresses the base64 text of a gzip stream.
export async function inflate(text) {
  const packed = Uint8Array.fromBase64?.(text) ?? Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

export class Container {
  constructor(bytes, header = null) {
    const length = header ? -4 : new DataView(bytes.buffer, bytes.byteOffset).getUint32(0, true);
    this.header = header ?? JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
    this.bytes = bytes.subarray(4 + length);
  }

  // Returns a container with the same arrays and another header.
  within(header) {
    return new Container(this.bytes, header);
  }

  // Returns a whole array as stored, row by row.
  stored(record) {
    const out = new TYPED[record.type](record.rows * record.width);
    this.#read(record, 0, record.rows, out, record.width, 0);
    return out;
  }

  // Returns a whole array in its real units.
  real(record) {
    const out = new Float32Array(record.rows * record.width);
    this.#read(record, 0, record.rows, out, record.width, 0);
    return out;
  }

  // Writes rows of a scene attribute from `first` on into `out`, from `offset` on, `stride` numbers apart.
  attribute(name, first, count, out, stride, offset = 0) {
    for (const record of this.header.attributes[name] ?? []) {
      const rows = Math.min(count, record.rows - first);
      if (rows > 0) {
        this.#read(record, first, rows, out, stride, offset);
        offset += rows * stride;
        count -= rows;
        first = 0;
      } else first -= record.rows;
    }
  }

  #read({ at, type, rows, width, scale, zero, curve }, first, count, out, stride, offset) {
    const bytes = this.bytes, size = BYTES[type], plane = rows * width, whole = type === "i4";
    for (let c = 0; c < width; c++) {
      const from = at + c * rows + first, factor = scale?.[c], middle = zero?.[c];
      for (let i = 0, to = offset + c; i < count; i++, to += stride) {
        const k = from + i;
        let value;
        if (size === 1) value = (bytes[k] << 24) >> 24;
        else if (size === 2) value = ((bytes[k] | (bytes[k + plane] << 8)) << 16) >> 16;
        else {
          word[0] = bytes[k] | (bytes[k + plane] << 8) | (bytes[k + 2 * plane] << 16) | (bytes[k + 3 * plane] << 24);
          value = whole ? word[0] | 0 : real[0];
        }
        if (scale) value = middle + factor * value;
        if (curve === "log") value = Math.sign(value) * Math.expm1(Math.abs(value));
        else if (curve === "logit") value = Math.log(value / (1 - value));
        out[to] = value;
      }
    }
  }
}
