"use strict";
// Draw Gaussians, sorted by depth, as quads that blend over each other. Coordinates are those of 3DGS: x right, y down,
// z forward in the camera.

const ROW = 1024;  // Gaussians in a row of the texture; each takes two texels of 16 bytes
const BUCKETS = 65536;
const START = JSON.parse(document.getElementById("start").textContent);
const NEAR = START.near;  // the least depth that is drawn

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D splats;
uniform mat3 rotation;
uniform vec3 place;
uniform float focal;
uniform vec2 size;
layout(location = 0) in uint index;
out vec4 color;
out vec2 offset;

mat3 matrix(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  ivec2 at = ivec2(int(index % ${ROW}u) * 2, int(index / ${ROW}u));
  uvec4 first = texelFetch(splats, at, 0), second = texelFetch(splats, at + ivec2(1, 0), 0);
  vec3 center = rotation * (uintBitsToFloat(first.xyz) - place);
  vec3 scale = uintBitsToFloat(uvec3(first.w, second.xy));
  color = vec4(uvec4(second.z, second.z >> 8, second.z >> 16, second.z >> 24) & 255u) / 255.0;
  vec4 q = vec4(uvec4(second.w, second.w >> 8, second.w >> 16, second.w >> 24) & 255u) - 128.0;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (center.z < ${NEAR} || color.a * 255.0 <= 1.0) return;

  // The covariance in the image: J V S S V^T J^T with the Jacobian J of the projection (Zwicker et al. 2001).
  mat3 axes = rotation * matrix(normalize(q)) * mat3(scale.x, 0, 0, 0, scale.y, 0, 0, 0, scale.z);
  vec2 limit = 0.65 * size / focal;
  vec2 slope = clamp(center.xy / center.z, -limit, limit);
  vec3 across = focal / center.z * (vec3(axes[0].x, axes[1].x, axes[2].x) - slope.x * vec3(axes[0].z, axes[1].z, axes[2].z));
  vec3 along = focal / center.z * (vec3(axes[0].y, axes[1].y, axes[2].y) - slope.y * vec3(axes[0].z, axes[1].z, axes[2].z));
  float a = dot(across, across) + 0.3, b = dot(across, along), c = dot(along, along) + 0.3;
  float middle = 0.5 * (a + c), radius = length(vec2(0.5 * (a - c), b));
  vec2 variance = vec2(middle + radius, max(middle - radius, 0.1));
  vec2 major = abs(b) > 1e-6 ? normalize(vec2(b, variance.x - a)) : (a >= c ? vec2(1, 0) : vec2(0, 1));

  float reach = sqrt(2.0 * log(255.0 * color.a));  // where the opacity falls to 1/255
  offset = reach * vec2(float(gl_VertexID & 1) * 2.0 - 1.0, float(gl_VertexID >> 1) * 2.0 - 1.0);
  vec2 corner = offset * sqrt(variance);
  vec2 pixel = focal * center.xy / center.z + corner.x * major + corner.y * vec2(-major.y, major.x);
  gl_Position = vec4(2.0 * pixel / size * vec2(1, -1), 0, 1);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec4 color;
in vec2 offset;
out vec4 result;
void main() {
  float alpha = min(0.99, color.a * exp(-0.5 * dot(offset, offset)));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(color.rgb * alpha, alpha);
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

/** Return the bytes of base64 text, filled up to whole rows of the texture. */
function decode(text) {
  const binary = atob(text.trim()), count = binary.length / 32;
  const bytes = new Uint8Array(Math.max(1, Math.ceil(count / ROW)) * ROW * 32);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return [bytes, count];
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
  constructor(bytes, count) {
    this.floats = new Float32Array(bytes.buffer);
    this.depths = new Float32Array(count);
    this.order = new Uint32Array(count);
    this.counts = new Uint32Array(BUCKETS + 1);
  }

  /** Sort the Gaussians in front of the camera, the farthest first; return their number. */
  sort(place, forward) {
    const { floats, depths, order, counts } = this;
    const [x, y, z] = forward, shift = dot(place, forward);
    let [least, most] = [Infinity, -Infinity];
    for (let i = 0; i < depths.length; i++) {
      const depth = depths[i] = floats[8 * i] * x + floats[8 * i + 1] * y + floats[8 * i + 2] * z - shift;
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

class Viewer {
  constructor(canvas, bytes, count, start) {
    this.canvas = canvas;
    this.start = start;
    this.camera = new Camera(start);
    this.sorter = new Sorter(bytes, count);
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!this.gl) throw new Error("this browser has no WebGL 2, which the viewer needs");
    this.prepare(bytes);
    this.listen();
    this.draw();
  }

  prepare(bytes) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.uniform = (name) => gl.getUniformLocation(program, name);
    const rows = bytes.length / 32 / ROW;
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("more Gaussians than this graphics card can hold");
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    const values = new Uint32Array(bytes.buffer);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, 2 * ROW, rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, values);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(...this.start.background, 1);
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
    gl.viewport(0, 0, canvas.width, canvas.height);
    const shown = this.sorter.sort(camera.place, camera.axes[2]);
    gl.bufferData(gl.ARRAY_BUFFER, this.sorter.order, gl.DYNAMIC_DRAW);
    gl.uniformMatrix3fv(this.uniform("rotation"), true, camera.axes.flat());
    gl.uniform3fv(this.uniform("place"), camera.place);
    gl.uniform1f(this.uniform("focal"), this.focal);
    gl.uniform2f(this.uniform("size"), canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, shown);
    canvas.dataset.shown = shown;
  }

  listen() {
    const canvas = this.canvas, fingers = new Map();
    addEventListener("resize", () => this.later());
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
      this.camera.zoom(Math.max(apart(before), 1) / Math.max(apart(now), 1));
      this.camera.move(x / 2, y / 2, focal);
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
clearInterval(loading);
state.textContent = "Preparing the scene";
// A task after the next frame: preparing takes seconds on a phone, which should show that it does.
requestAnimationFrame(() => setTimeout(() => {
  try {
    const [bytes, count] = decode(document.getElementById("splats").textContent);
    new Viewer(document.querySelector("canvas"), bytes, count, START);
    state.hidden = true;
    words.hidden = again.hidden = false;
  } catch (error) {
    state.textContent = `The scene cannot be shown: ${error.message}`;
  }
}));
