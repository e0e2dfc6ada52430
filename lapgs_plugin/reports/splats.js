"use strict";
// Draw Gaussians, sorted by depth, as quads that blend over each other. Coordinates are those of 3DGS: x right, y down,
// z forward in the camera. Levels of detail arrive in parts while the page loads, the coarsest first.

const ROW = 1024;  // Gaussians in a row of a texture
const WORDS = 8;  // of a Gaussian: position (3 floats), rotation, scale, colour and opacity, label, unused
const PLANES = 17;  // bytes of a Gaussian in a part
const COLUMNS = 64;  // sets of coefficients in a row of their texture
const BUCKETS = 65536;
const START = JSON.parse(document.getElementById("start").textContent);
const NEAR = START.near;  // the least depth that is drawn
const ANTIALIASED = Boolean(START.antialiased);  // whether Gaussians that are smaller than a pixel are dimmed

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uvec4 bytes(uint word) { return uvec4(word, word >> 8, word >> 16, word >> 24) & 255u; }
`;

const VERTEX = HEAD + `
uniform usampler2D splats;
uniform sampler2D colors;
uniform mat3 rotation;
uniform vec3 place;
uniform float focal;
uniform vec2 size;
uniform vec4 scales[64];
layout(location = 0) in uint index;
out vec4 color;
out vec2 offset;

mat3 matrix(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

/** Return the quaternion wxyz of its three smaller components and the index of the largest one. */
vec4 quaternion(uvec4 code) {
  vec3 small = (vec3(code.xyz) / 255.0 - 0.5) * sqrt(2.0);
  float large = sqrt(max(0.0, 1.0 - dot(small, small)));
  uint at = code.w - 252u;
  if (at == 0u) return vec4(large, small);
  if (at == 1u) return vec4(small.x, large, small.yz);
  return at == 2u ? vec4(small.xy, large, small.z) : vec4(small, large);
}

float logScale(uint code) { return scales[code >> 2][code & 3u]; }

void main() {
  ivec2 at = ivec2(int(index % ${ROW}u), int(index / ${ROW}u));
  uvec4 first = texelFetch(splats, at * ivec2(2, 1), 0), second = texelFetch(splats, at * ivec2(2, 1) + ivec2(1, 0), 0);
  vec3 center = rotation * (uintBitsToFloat(first.xyz) - place);
  uvec4 codes = bytes(second.x);
  vec3 scale = exp(vec3(logScale(codes.x), logScale(codes.y), logScale(codes.z)));
  color = texelFetch(colors, at, 0);
  vec4 q = quaternion(bytes(first.w));
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (center.z < ${NEAR} || color.a * 255.0 <= 1.0) return;

  // The covariance in the image: J V S S V^T J^T with the Jacobian J of the projection (Zwicker et al. 2001).
  mat3 axes = rotation * matrix(q) * mat3(scale.x, 0, 0, 0, scale.y, 0, 0, 0, scale.z);
  vec2 limit = 0.65 * size / focal;
  vec2 slope = clamp(center.xy / center.z, -limit, limit);
  vec3 across = focal / center.z * (vec3(axes[0].x, axes[1].x, axes[2].x) - slope.x * vec3(axes[0].z, axes[1].z, axes[2].z));
  vec3 along = focal / center.z * (vec3(axes[0].y, axes[1].y, axes[2].y) - slope.y * vec3(axes[0].z, axes[1].z, axes[2].z));
  float a = dot(across, across) + 0.3, b = dot(across, along), c = dot(along, along) + 0.3;
  if (${ANTIALIASED}) {  // the lower bound is that of 3DGS
    vec3 spanned = cross(across, along);  // its square is the determinant before the blur
    color.a *= sqrt(max(0.000025, dot(spanned, spanned) / (a * c - b * b)));
    if (color.a * 255.0 <= 1.0) return;
  }
  float middle = 0.5 * (a + c), radius = length(vec2(0.5 * (a - c), b));
  vec2 variance = vec2(middle + radius, max(middle - radius, 0.1));
  vec2 major = abs(b) > 1e-6 ? normalize(vec2(b, variance.x - a)) : (a >= c ? vec2(1, 0) : vec2(0, 1));

  float reach = sqrt(2.0 * log(255.0 * color.a));  // where the opacity falls to 1/255
  offset = reach * vec2(float(gl_VertexID & 1) * 2.0 - 1.0, float(gl_VertexID >> 1) * 2.0 - 1.0);
  vec2 corner = offset * sqrt(variance);
  vec2 pixel = focal * center.xy / center.z + corner.x * major + corner.y * vec2(-major.y, major.x);
  gl_Position = vec4(2.0 * pixel / size * vec2(1, -1), 0, 1);
}`;

const FRAGMENT = HEAD + `
in vec4 color;
in vec2 offset;
out vec4 result;
void main() {
  float alpha = min(0.99, color.a * exp(-0.5 * dot(offset, offset)));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(color.rgb * alpha, alpha);
}`;

const CORNERS = HEAD + `
void main() { gl_Position = vec4(4.0 * float(gl_VertexID & 1) - 1.0, 4.0 * float(gl_VertexID >> 1) - 1.0, 0, 1); }`;

// Spherical harmonics up to degree 3, in the order and with the signs of 3DGS.
const SHADE = HEAD + `
uniform usampler2D splats;
uniform usampler2D sets;
uniform vec3 place;
uniform int degree;
uniform vec4 colors[64];
uniform vec4 rest[64];
out vec4 result;

float base(uint code) { return colors[code >> 2][code & 3u]; }
float higher(uint code) { return rest[code >> 2][code & 3u]; }

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy) * ivec2(2, 1);
  uvec4 first = texelFetch(splats, at, 0), second = texelFetch(splats, at + ivec2(1, 0), 0);
  uvec4 code = bytes(second.y);
  vec3 color = 0.5 + ${Math.sqrt(1 / (4 * Math.PI))} * vec3(base(code.x), base(code.y), base(code.z));
  if (degree > 0) {
    vec3 d = normalize(uintBitsToFloat(first.xyz) - place);
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    float values[15] = float[15](
      -0.4886025119 * y, 0.4886025119 * z, -0.4886025119 * x,
      1.0925484306 * x * y, -1.0925484306 * y * z, 0.3153915653 * (2.0 * zz - xx - yy), -1.0925484306 * x * z,
      0.5462742153 * (xx - yy),
      -0.5900435899 * y * (3.0 * xx - yy), 2.8906114426 * x * y * z, -0.4570457995 * y * (4.0 * zz - xx - yy),
      0.3731763326 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -0.4570457995 * x * (4.0 * zz - xx - yy),
      1.4453057213 * z * (xx - yy), -0.5900435899 * x * (xx - 3.0 * yy));
    int count = (degree + 1) * (degree + 1) - 1, label = int(second.z);
    for (int k = 0; k < count; k++) {
      uvec3 set = texelFetch(sets, ivec2(label % ${COLUMNS} * count + k, label / ${COLUMNS}), 0).xyz;
      color += values[k] * vec3(higher(set.x), higher(set.y), higher(set.z));
    }
  }
  result = vec4(max(color, 0.0), float(code.w) / 255.0);
}`;

const add = (a, b) => a.map((value, i) => value + b[i]);
const subtract = (a, b) => a.map((value, i) => value - b[i]);
const times = (a, factor) => a.map((value) => value * factor);
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);

/** Return v turned by an angle around a unit axis (Rodrigues). */
function turned(v, axis, angle) {
  const cross = [0, 1, 2].map((i) => axis[(i + 1) % 3] * v[(i + 2) % 3] - axis[(i + 2) % 3] * v[(i + 1) % 3]);
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return v.map((value, i) => value * c + cross[i] * s + axis[i] * dot(axis, v) * (1 - c));
}

/** Return what base64 text holds, which zlib has compressed. */
async function unpack(text) {
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  if (!window.DecompressionStream) throw new Error("this browser is too old: it has no DecompressionStream");
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Gaussians of one level of detail, as many as have arrived: eight words each, filled up to rows of a texture. */
class Level {
  constructor(header) {
    Object.assign(this, header);
    this.rows = Math.max(1, Math.ceil(this.count / ROW));
    this.words = new Uint32Array(this.rows * ROW * WORDS);
    this.floats = new Float32Array(this.words.buffer);
    this.filled = 0;
    this.shaded = false;
    this.positions = this.count ? [0, 1, 2].map((axis) => this.table(axis)) : [];
  }

  get complete() {
    return this.filled === this.count;
  }

  /** Return the coordinate that each number of 16 bits stands for. */
  table(axis) {
    const table = new Float32Array(65536), step = (this.high[axis] - this.low[axis]) / 65535;
    for (let i = 0; i < table.length; i++) {
      const folded = this.low[axis] + i * step;
      table[i] = Math.sign(folded) * Math.expm1(Math.abs(folded));
    }
    return table;
  }

  /** Append the Gaussians of a part. */
  append(bytes) {
    const { words, floats, positions } = this, count = bytes.length / PLANES;
    const plane = (index) => bytes.subarray(index * count, (index + 1) * count);
    const planes = Array.from({ length: PLANES }, (_, index) => plane(index));
    for (let i = 0, at = this.filled * WORDS; i < count; i++, at += WORDS) {
      const byte = (index) => planes[index][i];
      const word = (p) => byte(p) | byte(p + 1) << 8 | byte(p + 2) << 16 | byte(p + 3) << 24;
      for (let axis = 0; axis < 3; axis++) {
        floats[at + axis] = positions[axis][byte(axis) | byte(axis + 3) << 8];
      }
      words[at + 3] = word(13);
      words[at + 4] = word(6) & 0xffffff;
      words[at + 5] = word(9);
    }
    this.filled += count;
  }

  /** Take the label of each Gaussian, and return the sets of coefficients: bytes RGB in rows of 64 sets. */
  shade(bytes) {
    const { words, count, sets, degree } = this, size = 3 * ((degree + 1) ** 2 - 1);
    for (let i = 0; i < count; i++) words[i * WORDS + 6] = bytes[i] | bytes[count + i] << 8;
    const texels = new Uint8Array(Math.ceil(sets / COLUMNS) * COLUMNS * size);
    texels.set(bytes.subarray(2 * count));
    this.shaded = true;
    return texels;
  }
}

class Camera {
  constructor(start) {
    this.start = start;
    this.reset();
  }

  reset() {
    const { place, rotation, target } = this.start;
    this.place = place;
    this.target = target;
    this.axes = [rotation.slice(0, 3), rotation.slice(3, 6), rotation.slice(6, 9)];  // right, down, forward
  }

  /** Turn around the target: first around the scene's up, then up or down, but not over the top. */
  turn(x, y) {
    this.rotate(this.start.up, x);
    const next = turned(this.axes[2], this.axes[0], y);
    if (Math.abs(dot(next, this.start.up)) < 0.99) this.rotate(this.axes[0], y);
  }

  rotate(axis, angle) {
    this.place = add(this.target, turned(subtract(this.place, this.target), axis, angle));
    this.axes = this.axes.map((each) => turned(each, axis, angle));
  }

  zoom(factor) {
    this.place = add(this.target, times(subtract(this.place, this.target), factor));
  }

  /** Move by so many pixels at the target's depth. */
  move(x, y, focal) {
    const scale = dot(subtract(this.target, this.place), this.axes[2]) / focal;
    const shift = add(times(this.axes[0], -x * scale), times(this.axes[1], -y * scale));
    this.place = add(this.place, shift);
    this.target = add(this.target, shift);
  }
}

class Sorter {
  constructor() {
    this.counts = new Uint32Array(BUCKETS + 1);
    this.hold(0);
  }

  /** Make room for so many Gaussians. */
  hold(count) {
    this.depths = new Float32Array(count);
    this.order = new Uint32Array(count);
  }

  /** Sort the Gaussians in front of the camera, the farthest first; return their number. */
  sort(floats, place, forward) {
    const { depths, order, counts } = this;
    const [x, y, z] = forward, shift = dot(place, forward);
    let [least, most] = [Infinity, -Infinity];
    for (let i = 0; i < depths.length; i++) {
      const depth = depths[i] = floats[WORDS * i] * x + floats[WORDS * i + 1] * y + floats[WORDS * i + 2] * z - shift;
      if (depth < NEAR) continue;
      if (depth < least) least = depth;
      if (depth > most) most = depth;
    }
    const scale = (BUCKETS - 1) / Math.max(most - least, 1e-9);
    counts.fill(0);
    for (let i = 0; i < depths.length; i++) {
      if (depths[i] >= NEAR) counts[1 + (((most - depths[i]) * scale) | 0)]++;
    }
    for (let i = 0; i < BUCKETS; i++) counts[i + 1] += counts[i];
    const shown = counts[BUCKETS];
    for (let i = 0; i < depths.length; i++) {
      if (depths[i] >= NEAR) order[counts[((most - depths[i]) * scale) | 0]++] = i;
    }
    return shown;
  }
}

/** What the graphics card holds of a level: Gaussians, their colours seen from the camera, sets of coefficients. */
class LevelTextures {
  constructor(gl, level) {
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (level.rows > most) throw new Error("more Gaussians than this graphics card can hold");
    Object.assign(this, { gl, level });
    this.splats = this.texture(gl.RGBA32UI, 2 * ROW, level.rows);
    // As in rasterizers, a colour may be brighter than white before it is blended.
    const bright = ["EXT_color_buffer_float", "EXT_color_buffer_half_float"].some((name) => gl.getExtension(name));
    this.colors = this.texture(bright ? gl.RGBA16F : gl.RGBA8, ROW, level.rows);
    this.sets = this.texture(gl.RGB8UI, 1, 1);
    this.target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.colors, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  texture(format, width, height) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    return texture;
  }

  /** Copy the Gaussians from a number on. */
  update(first) {
    const gl = this.gl, { words, filled } = this.level;
    const row = Math.floor(first / ROW), rows = Math.ceil(filled / ROW) - row;
    if (rows <= 0) return;
    gl.bindTexture(gl.TEXTURE_2D, this.splats);
    const values = words.subarray(row * ROW * WORDS, (row + rows) * ROW * WORDS);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, 2 * ROW, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, values);
  }

  hold(sets) {
    const gl = this.gl, width = COLUMNS * ((this.level.degree + 1) ** 2 - 1), height = sets.length / width / 3;
    gl.deleteTexture(this.sets);
    this.sets = this.texture(gl.RGB8UI, width, height);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGB_INTEGER, gl.UNSIGNED_BYTE, sets);
    this.update(0);  // the labels
  }

  remove() {
    for (const texture of [this.splats, this.colors, this.sets]) this.gl.deleteTexture(texture);
    this.gl.deleteFramebuffer(this.target);
  }
}

class Viewer {
  constructor(canvas, start) {
    this.canvas = canvas;
    this.start = start;
    this.camera = new Camera(start);
    this.sorter = new Sorter();
    this.complete = false;
    this.levels = start.levels.map((header) => new Level(header));
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!this.gl) throw new Error("this browser has no WebGL 2, which the viewer needs");
    this.prepare();
    this.listen();
  }

  prepare() {
    const gl = this.gl;
    this.splatting = this.program(VERTEX, FRAGMENT);
    this.shading = this.program(CORNERS, SHADE);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(...this.start.background, 1);
  }

  program(...sources) {
    const gl = this.gl, program = gl.createProgram();
    sources.forEach((source, index) => {
      const shader = gl.createShader([gl.VERTEX_SHADER, gl.FRAGMENT_SHADER][index]);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    });
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  /** Take the next part of the scene. The first level is shown as it comes, others when they are complete. */
  take(bytes) {
    const level = this.levels.find((each) => !each.complete || each.degree && !each.shaded);
    if (this.arriving?.level !== level) this.arriving = new LevelTextures(this.gl, level);
    const first = level.filled;
    if (level.complete) {
      this.arriving.hold(level.shade(bytes));
    } else {
      level.append(bytes);
      this.arriving.update(first);
    }
    if (level.complete || level === this.levels[0]) this.show(this.arriving);
  }

  show(textures) {
    if (this.shown !== textures) this.shown?.remove();
    this.shown = textures;
    this.sorter.hold(textures.level.filled);
    this.shadedFrom = null;
    this.later();
  }

  /** Focal length in pixels at which the first photo fills the window: what is beside it was never photographed. */
  get focal() {
    const [x, y] = this.start.focal;
    return Math.max(x * this.canvas.width, y * this.canvas.height);
  }

  later() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => this.draw());
  }

  draw() {
    const gl = this.gl, canvas = this.canvas, camera = this.camera;
    this.waiting = false;
    const ratio = Math.min(devicePixelRatio, 2);
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!this.shown) return;
    this.shade();
    const shown = this.sorter.sort(this.shown.level.floats, camera.place, camera.axes[2]);
    gl.bufferData(gl.ARRAY_BUFFER, this.sorter.order, gl.DYNAMIC_DRAW);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.enable(gl.BLEND);
    gl.enableVertexAttribArray(0);
    const uniform = this.use(this.splatting, this.shown.splats, this.shown.colors);
    gl.uniform1i(uniform("splats"), 0);
    gl.uniform1i(uniform("colors"), 1);
    gl.uniformMatrix3fv(uniform("rotation"), true, camera.axes.flat());
    gl.uniform3fv(uniform("place"), camera.place);
    gl.uniform1f(uniform("focal"), this.focal);
    gl.uniform2f(uniform("size"), canvas.width, canvas.height);
    if (this.shown.level.scales) gl.uniform4fv(uniform("scales"), this.shown.level.scales);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, shown);
    canvas.dataset.shown = shown;
    canvas.dataset.level = this.levels.indexOf(this.shown.level);
    if (this.complete) canvas.dataset.complete = "";
  }

  /** Compute the colours of all Gaussians from where the camera is. */
  shade() {
    const gl = this.gl, { level, target, splats, sets } = this.shown;
    if (this.shadedFrom === this.camera.place || !level.count) return;
    this.shadedFrom = this.camera.place;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, ROW, Math.ceil(level.filled / ROW));
    gl.disable(gl.BLEND);
    gl.disableVertexAttribArray(0);
    const uniform = this.use(this.shading, splats, sets);
    gl.uniform1i(uniform("splats"), 0);
    gl.uniform1i(uniform("sets"), 1);
    gl.uniform3fv(uniform("place"), this.camera.place);
    gl.uniform1i(uniform("degree"), level.shaded ? level.degree : 0);
    gl.uniform4fv(uniform("colors"), level.colors);
    if (level.shaded) gl.uniform4fv(uniform("rest"), level.rest);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  /** Use a program with textures, and return where a uniform of it is. */
  use(program, ...textures) {
    const gl = this.gl;
    gl.useProgram(program);
    textures.forEach((texture, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.activeTexture(gl.TEXTURE0);
    return (name) => gl.getUniformLocation(program, name);
  }

  listen() {
    const canvas = this.canvas, fingers = new Map();
    addEventListener("resize", () => this.later());
    const lost = new Error("the graphics card lost it; load the page again");
    canvas.addEventListener("webglcontextlost", () => fail(lost));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event);
      if (event.pointerType === "touch") words.hidden = true;  // a phone has no H
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    }
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const others = [...fingers.values()].filter((each) => each.pointerId !== event.pointerId);
      this.drag(before, event, others[0]);
      fingers.set(event.pointerId, event);
      this.later();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.camera.zoom(Math.exp(0.001 * event.deltaY * (event.deltaMode === 1 ? 30 : 1)));
      this.later();
    }, { passive: false });
    addEventListener("keydown", (event) => this.key(event));
    again.addEventListener("click", () => {
      this.camera.reset();
      this.later();
    });
  }

  drag(before, now, other) {
    const x = now.clientX - before.clientX, y = now.clientY - before.clientY;
    const focal = this.focal / (this.canvas.width / this.canvas.clientWidth);
    if (other) {
      const apart = (each) => Math.hypot(each.clientX - other.clientX, each.clientY - other.clientY);
      const factor = Math.max(apart(before), 1) / Math.max(apart(now), 1);
      this.camera.zoom(factor);
      // What is between the fingers stays there, at the depth of the target.
      const middle = (a, b, size) => (a + b) / 2 - size / 2;
      const [across, down] = [
        middle(before.clientX, other.clientX, this.canvas.clientWidth),
        middle(before.clientY, other.clientY, this.canvas.clientHeight),
      ];
      this.camera.move(x / 2 + across * (1 - 1 / factor), y / 2 + down * (1 - 1 / factor), focal);
    } else if (now.buttons & 2 || now.shiftKey) {
      this.camera.move(x, y, focal);
    } else {
      this.camera.turn(-0.005 * x, -0.005 * y);
    }
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const turns = { ArrowLeft: [-0.05, 0], ArrowRight: [0.05, 0], ArrowUp: [0, -0.05], ArrowDown: [0, 0.05] };
    const zooms = { "+": 0.9, "=": 0.9, "-": 1 / 0.9 };
    if (turns[event.key]) this.camera.turn(...turns[event.key]);
    else if (zooms[event.key]) this.camera.zoom(zooms[event.key]);
    else if (event.key.toLowerCase() === "r") this.camera.reset();
    else if (event.key.toLowerCase() === "h") words.hidden = again.hidden = !words.hidden;
    else return;
    event.preventDefault();
    this.later();
  }
}

const words = document.getElementById("words"), again = document.querySelector("button");
const state = document.getElementById("state"), bar = document.querySelector("progress");
let [viewer, failed, unpacked, taken] = [null, false, 0, Promise.resolve()];

function fail(error) {
  failed = true;
  clearInterval(loading);
  bar.hidden = true;
  state.hidden = false;
  state.textContent = `The scene cannot be shown: ${error.message}`;
}

/** Show how much of the page is here: over a network it may take minutes. */
function progress() {
  let here = unpacked;
  for (const part of document.querySelectorAll("script.part")) here += part.firstChild?.length ?? 0;
  bar.value = here / Math.max(bar.dataset.characters, 1);
  state.textContent = `Loading the scene: ${Math.floor(100 * bar.value)} %`;
}
const loading = setInterval(progress, 100);

/** Unpack the part that the page has before this script, when all before it are. */
function arrived() {
  const part = document.currentScript.previousElementSibling;
  taken = taken.then(async () => {
    if (failed) return;
    const bytes = await unpack(part.textContent);
    unpacked += part.textContent.length;
    part.remove();
    viewer.take(bytes);
    state.hidden = true;
    words.hidden = again.hidden = false;
  }).catch(fail);
}

function finished() {
  taken.then(() => {
    if (failed) return;
    clearInterval(loading);
    bar.hidden = state.hidden = true;
    viewer.complete = true;
    viewer.later();
  });
}

try {
  viewer = new Viewer(document.querySelector("canvas"), START);
} catch (error) {
  fail(error);
}
