// WebGL2 renderer with the viewer's own shaders: one pass over all Gaussians, farthest first, then the picture.

import { dot } from "./camera.js";

const ROW = 512;        // Gaussians in a row of the scene's textures, as in viewer/gl/scene_textures.py
const ORDER_ROW = 2048;
const CHUNK = 64;       // texture rows unpacked at once
const HEAD = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;";
const LAYOUT = {
  mean_logit: [["means", 0], ["logit_opacities", 3]],
  log_scale: [["log_scales", 0]], quat: [["quats", 0]], sh0: [["sh0", 0]], shN: [["shN", 0]],
};
const TEXTURE_OF = {
  means: "mean_logit", logit_opacities: "mean_logit", log_scales: "log_scale", quats: "quat", sh0: "sh0", shN: "shN",
};

export class Renderer {
  constructor(canvas, shaders, container) {
    const options = { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" };
    const gl = canvas.getContext("webgl2", options);
    if (!gl) throw new Error("no WebGL2");
    this.gl = gl;
    this.canvas = canvas;
    const float = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.format = float ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
    this.count = container.header.count;
    this.sh = container.header.sh;
    if (Math.ceil(this.count / ROW) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error("this device's textures are too small for the scene");
    }
    this.splats = this.#program(shaders, "web.vert", "splat.frag");
    this.present = this.#program(shaders, "present.vert", "present.frag");
    this.stretch = this.#program(shaders, "present.vert", "stretch.frag");
    this.textures = {};
    this.order = this.#texture();
    const rows = Math.max(1, Math.ceil(this.count / ORDER_ROW));
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, ORDER_ROW, rows);
    this.staged = new Uint32Array(ORDER_ROW * rows);
    this.drawn = null;  // number of Gaussians in order; null before the first order
    for (const name of Object.keys(LAYOUT)) this.#upload(name, container);
    gl.useProgram(this.splats.program);
    Object.keys(LAYOUT).forEach((name, at) => gl.uniform1i(this.splats.at(name), at));
    gl.uniform1i(this.splats.at("order"), 5);
    gl.uniform1i(this.splats.at("sh_coefficients"), this.sh);
    gl.uniform1i(this.splats.at("antialiased"), container.header.antialiased ? 1 : 0);
    gl.bindVertexArray(gl.createVertexArray());
  }

  // Uploads ranges of rows of a composer's attributes `names`.
  update(composer, { ranges, names }) {
    for (const texture of new Set(names.map((name) => TEXTURE_OF[name]))) {
      for (const [first, last] of ranges) {
        const begin = Math.floor(first / ROW) * ROW, end = Math.min(Math.ceil(last / ROW) * ROW, composer.count);
        this.#send(texture, begin, end - begin, ...this.#texels(composer, texture, begin, end));
      }
    }
  }

  #texels({ widths, after }, texture, begin, end) {
    const [[name]] = LAYOUT[texture], channels = texture === "shN" ? widths.shN : 4;
    if (widths[name] === channels) return [after[name].subarray(begin * channels, end * channels), channels];
    const numbers = new Float32Array((end - begin) * channels);
    for (const [each, offset] of LAYOUT[texture]) {
      const width = widths[each], from = after[each];
      for (let row = begin, to = offset; row < end; row++, to += channels) {
        for (let c = 0; c < width; c++) numbers[to + c] = from[row * width + c];
      }
    }
    return [numbers, channels];
  }

  setOrder(order, seen) {
    const { gl } = this, rows = Math.ceil(seen / ORDER_ROW);
    this.staged.set(order.subarray(0, seen));
    this.drawn = seen;
    gl.activeTexture(gl.TEXTURE5);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ORDER_ROW, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, this.staged);
  }

  // Draws a pinhole camera's picture on the canvas; a share below 1 draws fewer pixels and enlarges them.
  draw(pinhole, background, share = 1) {
    const { gl } = this, { canvas } = this;
    const width = Math.max(1, Math.round(canvas.width * share)), height = Math.max(1, Math.round(canvas.height * share));
    this.#pass(pinhole, [width, height], [width / pinhole.width, height / pinhole.height], background, false);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.disable(gl.BLEND);
    const show = share < 1 ? this.stretch : this.present;
    gl.useProgram(show.program);
    gl.activeTexture(gl.TEXTURE6);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.uniform1i(show.at("picture"), 6);
    gl.uniform1i(show.at("left"), 0);
    gl.uniform2f(show.at("shown_size"), canvas.width, canvas.height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Returns the depth of the surface at a pixel of the canvas, world units; null in empty space.
  depthAt(pinhole, x, y) {
    const { gl } = this, pixel = new Float32Array(4);
    if (this.format[0] === gl.RGBA8) return null;
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(Math.floor(x), Math.floor(y), 1, 1);
    this.#pass(pinhole, [this.canvas.width, this.canvas.height], [1, 1], [0, 0, 0], true);
    gl.disable(gl.SCISSOR_TEST);
    gl.readPixels(Math.floor(x), Math.floor(y), 1, 1, gl.RGBA, gl.FLOAT, pixel);
    return pixel[3] > 0.3 ? pixel[0] / pixel[3] : null;
  }

  release() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  #pass(pinhole, [width, height], [sx, sy], background, depths) {
    const { gl, splats } = this, { rows, eye } = pinhole, [fx, fy, cx, cy] = pinhole.intrinsics;
    this.#resize(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...background, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(splats.program);
    Object.keys(LAYOUT).forEach((name, at) => {
      gl.activeTexture(gl.TEXTURE0 + at);
      gl.bindTexture(gl.TEXTURE_2D, this.textures[name]);
    });
    const high = eye.map(Math.fround);
    gl.uniformMatrix3fv(splats.at("rotation"), true, rows.flat());
    gl.uniform3f(splats.at("eye_high"), ...high);
    gl.uniform3f(splats.at("eye_low"), ...eye.map((x, i) => x - high[i]));
    gl.uniform4f(splats.at("intrinsics"), fx * sx, fy * sy, cx * sx, cy * sy);
    gl.uniform2f(splats.at("size"), width, height);
    gl.uniform1i(splats.at("depths"), depths ? 1 : 0);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.TRIANGLES, 0, 3 * this.drawn);
  }

  #resize(width, height) {
    const { gl, target } = this;
    if (target?.width === width && target.height === height) return;
    if (target) {
      gl.deleteTexture(target.texture);
      gl.deleteFramebuffer(target.framebuffer);
    }
    const texture = this.#texture(6), framebuffer = gl.createFramebuffer();
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.format[0], width, height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.target = { texture, framebuffer, width, height };
  }

  #texture(unit = 7) {
    const { gl } = this, texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    return texture;
  }

  #upload(name, container) {
    const { gl } = this, rows = Math.max(1, Math.ceil(this.count / ROW));
    const texels = name === "shN" ? this.sh : 1, channels = name === "shN" ? 3 * this.sh : 4;
    this.textures[name] = this.#texture();
    gl.texStorage2D(gl.TEXTURE_2D, 1, name === "shN" ? gl.RGB32F : gl.RGBA32F, ROW * Math.max(texels, 1), rows);
    if (!channels) return;
    for (let first = 0; first < this.count; first += CHUNK * ROW) {
      const count = Math.min(CHUNK * ROW, this.count - first), numbers = new Float32Array(count * channels);
      for (const [attribute, offset] of LAYOUT[name]) container.attribute(attribute, first, count, numbers, channels, offset);
      this.#send(name, first, count, numbers, channels);
    }
  }

  // Uploads Gaussians from the start of a texture row: whole texture rows, then the remainder of the last one.
  #send(name, first, count, numbers, channels) {
    const { gl } = this, texels = name === "shN" ? this.sh : 1, format = name === "shN" ? gl.RGB : gl.RGBA;
    const whole = Math.floor(count / ROW), left = count - whole * ROW, top = first / ROW;
    gl.activeTexture(gl.TEXTURE7);
    gl.bindTexture(gl.TEXTURE_2D, this.textures[name]);
    const put = (y, width, height, from) =>
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, y, width * texels, height, format, gl.FLOAT, numbers, from);
    if (whole) put(top, ROW, whole, 0);
    if (left) put(top + whole, left, 1, whole * ROW * channels);
  }

  #program(shaders, vertex, fragment) {
    const { gl } = this, program = gl.createProgram(), places = {};
    for (const [kind, name] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, HEAD + shaders[name]);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`${name}: ${gl.getShaderInfoLog(shader)}`);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return { program, at: (name) => (places[name] ??= gl.getUniformLocation(program, name)) };
  }
}

// The row of the view matrix that yields depths.
export const depthRow = ({ rows, eye }) => [...rows[2], -dot(rows[2], eye)];
