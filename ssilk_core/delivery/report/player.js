// SPDX-License-Identifier: Apache-2.0
// Plays shots in a page: the points of each frame, packed by player.py, drawn by WebGL 2. Loads nothing.
"use strict";

const VERTEX = `#version 300 es
in vec3 place; in vec3 normal;
uniform mat4 view; uniform vec3 eye;
out vec3 n, toEye, at;
void main() { n = normal; toEye = eye - place; at = place; gl_Position = view * vec4(place, 1.0); }`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 n, toEye, at;
uniform vec3 colour; uniform float ground;
out vec4 pixel;
void main() {
  vec3 up = normalize(n), look = normalize(toEye);
  if (dot(up, look) < 0.0) up = -up;
  float key = max(dot(up, normalize(vec3(0.4, 0.8, 0.5))), 0.0);
  float fill = max(dot(up, normalize(vec3(-0.7, 0.2, -0.3))), 0.0);
  vec3 lit = pow(colour, vec3(2.2)) * (0.22 + 0.75 * key + 0.25 * fill) + 0.05 * pow(1.0 - abs(dot(up, look)), 3.0);
  vec2 cell = floor(at.xz * 2.0);
  float board = mod(cell.x + cell.y, 2.0) < 0.5 ? 0.80 : 0.74;
  float fade = clamp(length(toEye) / 14.0, 0.0, 1.0);
  pixel = vec4(pow(ground > 0.5 ? mix(vec3(board), vec3(0.87), fade) * 0.8 : lit, vec3(1.0 / 2.2)), 1.0);
}`;

async function inflated(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Undo what `packed` did: low and high bytes apart, zigzag, second differences in time.
function unpacked(bytes, frames, width) {
  const count = frames * width, values = new Int16Array(count);
  for (let i = 0; i < count; i++) {
    const word = bytes[i] | (bytes[count + i] << 8);
    let value = (word >>> 1) ^ -(word & 1);
    if (i >= width) value += 2 * values[i - width] - (i >= 2 * width ? values[i - 2 * width] : 0);
    values[i] = value;
  }
  return values;
}

class Surface {
  constructor(gl, about, bytes, frames) {
    Object.assign(this, about);
    const cut = 4 * this.triangles * 3;
    this.faces = new Uint32Array(bytes.slice(0, cut).buffer);
    this.values = unpacked(bytes.subarray(cut), this.place ? 1 : frames, 3 * this.points);
    this.shown = true;
    this.places = new Float32Array(3 * this.points);
    this.normals = new Float32Array(3 * this.points);
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    this.buffers = [0, 1].map((slot) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(slot);
      gl.vertexAttribPointer(slot, 3, gl.FLOAT, false, 0, 0);
      return buffer;
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, this.faces, gl.STATIC_DRAW);
  }

  // What has a place of its own stays there, and has one frame.
  pose(gl, now, part, path) {
    const [before, share, origins] = this.place ? [0, 0, [this.place]] : [now, part, path];
    const width = 3 * this.points, after = Math.min(before + 1, origins.length - 1);
    for (let i = 0; i < width; i++) {
      const axis = i % 3;
      const a = origins[before][axis] + this.step * this.values[before * width + i];
      const b = origins[after][axis] + this.step * this.values[after * width + i];
      this.places[i] = a + share * (b - a);
    }
    const { places: p, normals: n, faces: f } = this;
    n.fill(0);
    for (let i = 0; i < f.length; i += 3) {
      const a = 3 * f[i], b = 3 * f[i + 1], c = 3 * f[i + 2];
      const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
      const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
      const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
      for (const k of [a, b, c]) { n[k] += x; n[k + 1] += y; n[k + 2] += z; }
    }
    [p, n].forEach((data, slot) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[slot]);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    });
  }
}

function program(gl) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.bindAttribLocation(made, 0, "place");
  gl.bindAttribLocation(made, 1, "normal");
  gl.linkProgram(made);
  return made;
}

// World to clip, column by column, of a camera at `eye` that looks at `target`, y up.
function camera(eye, target, aspect) {
  const unit = (v) => v.map((each) => each / Math.hypot(...v));
  const cross = (a, b) => [0, 1, 2].map((i) => a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const back = unit([0, 1, 2].map((i) => eye[i] - target[i])), right = unit(cross([0, 1, 0], back));
  const up = cross(back, right), near = 0.05, far = 200, lens = 2.2;
  const rows = [[...right, -dot(right, eye)], [...up, -dot(up, eye)], [...back, -dot(back, eye)]];
  const deep = (far + near) / (near - far), push = (2 * far * near) / (near - far);
  const out = [];
  for (let c = 0; c < 4; c++) {
    const depth = rows[2][c];
    out.push((lens / aspect) * rows[0][c], lens * rows[1][c], deep * depth + (c === 3 ? push : 0), -depth);
  }
  return new Float32Array(out);
}

async function play(figure) {
  const about = JSON.parse(figure.dataset.about);
  const canvas = figure.querySelector("canvas"), slider = figure.querySelector("input[type=range]");
  const button = figure.querySelector("button"), clock = figure.querySelector("output");
  const speed = figure.querySelector("select"), note = figure.querySelector(".note");
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) { note.textContent = "This browser has no WebGL 2."; return; }
  const data = [...figure.querySelectorAll("script")].map((part) => inflated(part.textContent));
  const frames = about.origins.length, surfaces = [];
  for (const [number, bytes] of (await Promise.all(data)).entries())
    surfaces.push(new Surface(gl, about.meshes[number], bytes, frames));
  const floor = new Surface(gl, { points: 4, triangles: 2, step: 1, colour: [1, 1, 1] },
    new Uint8Array(new Uint32Array([0, 1, 2, 0, 2, 3]).buffer), 0);
  const made = program(gl), of = (name) => gl.getUniformLocation(made, name);
  const [view, eyeAt, colour, ground] = ["view", "eye", "colour", "ground"].map(of);
  let turn = 0.6, tilt = 0.12, away = about.distance, playing = frames > 1, seconds = 0, last = null, stale = true;
  slider.max = (frames - 1) / about.fps;

  function draw() {
    const size = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.round(side * devicePixelRatio));
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    const position = Math.min(seconds * about.fps, frames - 1), before = Math.floor(position);
    const share = position - before, after = Math.min(before + 1, frames - 1);
    const target = [0, 1, 2].map((i) => about.centres[before][i] * (1 - share) + about.centres[after][i] * share);
    const eye = [target[0] + away * Math.sin(turn) * Math.cos(tilt), target[1] + away * Math.sin(tilt),
      target[2] + away * Math.cos(turn) * Math.cos(tilt)];
    gl.viewport(0, 0, ...size);
    gl.clearColor(0.87, 0.87, 0.87, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(made);
    gl.uniformMatrix4fv(view, false, camera(eye, target, size[0] / size[1]));
    gl.uniform3fv(eyeAt, eye);
    const reach = 15, [x, , z] = target, y = about.ground;
    floor.places.set([x - reach, y, z - reach, x - reach, y, z + reach, x + reach, y, z + reach, x + reach, y, z - reach]);
    floor.normals.set([0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1, 0]);
    [floor.places, floor.normals].forEach((part, slot) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, floor.buffers[slot]);
      gl.bufferData(gl.ARRAY_BUFFER, part, gl.DYNAMIC_DRAW);
    });
    for (const surface of surfaces) if (surface.shown) surface.pose(gl, before, share, about.origins);
    for (const surface of [floor, ...surfaces]) {
      if (!surface.shown) continue;
      gl.uniform3fv(colour, surface.colour);
      gl.uniform1f(ground, surface === floor ? 1 : 0);
      gl.bindVertexArray(surface.array);
      gl.drawElements(gl.TRIANGLES, 3 * surface.triangles, gl.UNSIGNED_INT, 0);
    }
    slider.value = seconds;
    button.textContent = playing ? about.words.pause : about.words.play;
    clock.textContent = `${about.words.frame} ${(about.start + position * about.step).toFixed(1)} · ${seconds.toFixed(2)} s`;
    canvas.dataset.drawn = String(position);
  }

  function tick(now) {
    if (playing && last !== null) {
      const end = (frames - 1) / about.fps;
      seconds = end > 0 ? (seconds + ((now - last) / 1000) * Number(speed.value)) % end : 0;
    }
    last = now;
    if (playing || stale) draw();
    stale = false;
    requestAnimationFrame(tick);
  }

  const seek = (moment) => { seconds = Math.max(0, Math.min(moment, (frames - 1) / about.fps)); playing = false; stale = true; };
  button.addEventListener("click", () => { playing = !playing; stale = true; });
  slider.addEventListener("input", () => seek(Number(slider.value)));
  addEventListener("resize", () => { stale = true; });
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    turn -= event.movementX / 150;
    tilt = Math.max(-0.3, Math.min(1.5, tilt + event.movementY / 150));
    stale = true;
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    away = Math.max(0.3, Math.min(60, away * Math.exp(event.deltaY / 800)));
    stale = true;
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    if (event.key === " ") { playing = !playing; stale = true; event.preventDefault(); }
    if (event.key === "ArrowLeft") seek(seconds - 1 / about.fps);
    if (event.key === "ArrowRight") seek(seconds + 1 / about.fps);
  });
  for (const [number, box] of figure.querySelectorAll("input[type=checkbox]").entries())
    box.addEventListener("change", () => { surfaces[number].shown = box.checked; stale = true; });
  for (const picture of document.querySelectorAll("[data-seconds]"))
    picture.addEventListener("click", () => { seek(Number(picture.dataset.seconds)); figure.scrollIntoView(); });
  note.textContent = about.words.hint;
  requestAnimationFrame(tick);
}

for (const figure of document.querySelectorAll(".player"))
  play(figure).catch((error) => { figure.querySelector(".note").textContent = String(error); });
