// Drawing: one quad per splat, far to near, projected as the rasterizer of the command line does. An instance is BATCH
// quads: drivers, and above all software ones, spend as much on an instance of four vertices as on a hundred.

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
precision highp sampler2D;
layout(location = 0) in vec3 vertex;   // corner, and quad of the instance
uniform usampler2D order, core, shape, motion;
uniform sampler2D frames, ramp;
uniform mat3 toCamera;
uniform vec3 eye;
uniform vec2 focal, middle, size;
uniform vec4 lens;         // bounds of x/z and y/z in the projection's slope
uniform float lowPass, grow;
uniform int still, mode, compensate, count;
uniform vec2 depthRange;   // natural logarithms
uniform float topSpeed;
out vec2 place;
flat out vec4 paint;

ivec2 cell(uint i) { return ivec2(int(i & 2047u), int(i >> 11)); }
vec4 bytes(uint w) { return vec4(w & 255u, (w >> 8) & 255u, (w >> 16) & 255u, w >> 24); }

// Hue by direction seen from above, saturation by speed; white stands still.
vec3 wheel(vec3 v) {
  float speed = length(v.xz);
  if (speed < 1e-9) return vec3(1.0);
  float h = mod(atan(v.z, v.x) / 6.2831853 + 1.0, 1.0) * 6.0;
  vec3 k = mod(h + vec3(0.0, 4.0, 2.0), 6.0);
  vec3 pure = clamp(abs(k - 3.0) - 1.0, 0.0, 1.0);
  return 1.0 - min(speed / topSpeed, 1.0) * (1.0 - pure);
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  int slot = gl_InstanceID * 128 + int(vertex.z);
  if (slot >= count) return;
  vec2 corner = vertex.xy;
  uint index = texelFetch(order, cell(uint(slot)), 0).x;
  uvec4 a = texelFetch(core, cell(index), 0), b = texelFetch(shape, cell(index), 0);
  vec3 p = uintBitsToFloat(a.xyz), velocity = vec3(0.0);
  int m = int(index) - still;
  if (m >= 0) {
    uvec4 c = texelFetch(motion, cell(uint(m)), 0);
    vec2 u = unpackHalf2x16(c.x), v = unpackHalf2x16(c.y), w = unpackHalf2x16(c.z);
    vec3 forward = vec3(u, v.x), backward = vec3(v.y, w);
    vec4 f = texelFetch(frames, ivec2(int(c.w), 0), 0);
    p += f.y * forward + f.z * backward;
    // The first frame knows no backward motion, the last no forward one.
    float share = c.w == 0u ? 1.0 : int(c.w) == textureSize(frames, 0).x - 1 ? 0.0 : 0.5;
    velocity = share * forward - (1.0 - share) * backward;
  }
  vec3 q = toCamera * (p - eye);
  vec2 s01 = unpackHalf2x16(b.x), s2 = unpackHalf2x16(b.y);
  vec3 s = grow * vec3(s01, s2.x);
  vec4 r = normalize(mix(bytes(b.z), bytes(b.z) - 256.0, greaterThan(bytes(b.z), vec4(127.0))));
  mat3 turn = mat3(
    1.0 - 2.0 * (r.z * r.z + r.w * r.w), 2.0 * (r.y * r.z + r.x * r.w), 2.0 * (r.y * r.w - r.x * r.z),
    2.0 * (r.y * r.z - r.x * r.w), 1.0 - 2.0 * (r.y * r.y + r.w * r.w), 2.0 * (r.z * r.w + r.x * r.y),
    2.0 * (r.y * r.w + r.x * r.z), 2.0 * (r.z * r.w - r.x * r.y), 1.0 - 2.0 * (r.y * r.y + r.z * r.z));
  mat3 root = toCamera * turn * mat3(s.x, 0.0, 0.0, 0.0, s.y, 0.0, 0.0, 0.0, s.z);
  vec2 slope = clamp(q.xy / q.z, lens.xy, lens.zw);
  vec3 jx = vec3(focal.x / q.z, 0.0, -focal.x * slope.x / q.z) * root;
  vec3 jy = vec3(0.0, focal.y / q.z, -focal.y * slope.y / q.z) * root;
  float sxx = dot(jx, jx), sxy = dot(jx, jy), syy = dot(jy, jy);
  float bare = sxx * syy - sxy * sxy;
  sxx += lowPass;
  syy += lowPass;
  vec4 rgba = bytes(a.w) / 255.0;
  if (compensate == 1) rgba.a *= sqrt(max(2.5e-5, bare / (sxx * syy - sxy * sxy)));
  float reach = 2.0 * log(255.0 * rgba.a);
  if (!(reach > 0.0)) return;
  // Principal axes of the ellipse; the larger difference is the one without cancellation.
  float mid = 0.5 * (sxx + syy), spread = length(vec2(0.5 * (sxx - syy), sxy));
  vec2 axis = sxx >= syy ? vec2(mid + spread - syy, sxy) : vec2(sxy, mid + spread - sxx);
  axis = spread > 0.0 ? normalize(axis) : vec2(1.0, 0.0);
  place = corner * sqrt(reach);
  vec2 side = sqrt(max(vec2(mid + spread, mid - spread), 0.0));
  vec2 pixel = focal * q.xy / q.z + middle;
  pixel += place.x * side.x * axis + place.y * side.y * vec2(-axis.y, axis.x);
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);

  float light = dot(rgba.rgb, vec3(0.299, 0.587, 0.114));
  if (mode == 1) {
    float moving = m >= 0 ? float(b.w) / 255.0 : 0.0;
    rgba.rgb = mix(vec3(0.06 + 0.45 * light), vec3(1.0, 0.55, 0.16) * (0.55 + 0.45 * light), moving);
  } else if (mode == 2) {
    rgba.rgb = wheel(velocity) * (0.25 + 0.75 * light);
  } else if (mode == 3) {
    float d = (log(q.z) - depthRange.x) / (depthRange.y - depthRange.x);
    rgba.rgb = texture(ramp, vec2(clamp(d, 0.0, 1.0), 0.5)).rgb;
  }
  paint = rgba;
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 place;
flat in vec4 paint;
uniform float most;
out vec4 result;
void main() {
  float alpha = paint.a * exp(-0.5 * dot(place, place));
  if (alpha < 1.0 / 255.0) discard;
  alpha = min(alpha, most);
  result = vec4(paint.rgb * alpha, alpha);
}`;

const MODES = ['rgb', 'dynamic', 'velocity', 'depth'];
/** Splats in a row of the textures. */
const ROW = 2048;
/** Quads of an instance; the vertex program has the same number. */
const BATCH = 128;

class Drawer {
  constructor(gl, info, splats) {
    Object.assign(this, { gl, info, splats, sorter: new Sorter(splats) });
    this.program = link(gl);
    this.at = {};
    const uniforms = gl.getProgramParameter(this.program, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < uniforms; i++) {
      const name = gl.getActiveUniform(this.program, i).name;
      this.at[name] = gl.getUniformLocation(this.program, name);
    }
    this.upload();
    this.vertices = gl.createVertexArray();
    gl.bindVertexArray(this.vertices);
    const quads = Array.from({ length: BATCH }, (_, q) => q);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, Float32Array.from(quads.flatMap(q => [-1, -1, q, 1, -1, q, -1, 1, q, 1, 1, q])), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint16Array.from(quads.flatMap(q => [0, 1, 2, 2, 1, 3].map(v => 4 * q + v))), gl.STATIC_DRAW);
    this.sortedFor = '';
  }

  /** The splats as textures of four words each. */
  upload() {
    const { gl, splats, info } = this;
    const words = (count, fill) => {
      const rows = Math.max(1, Math.ceil(count / ROW));
      const data = new Uint32Array(4 * ROW * rows);
      for (let i = 0; i < count; i++) fill(data, 4 * i, i);
      return { data, rows };
    };
    const centre = new Uint32Array(splats.centre.buffer, splats.centre.byteOffset, splats.centre.length);
    const word = (list, i) => (list[4 * i] | list[4 * i + 1] << 8 | list[4 * i + 2] << 16 | list[4 * i + 3] << 24) >>> 0;
    const { scale, motion } = splats;
    const parts = {
      core: words(splats.count, (d, o, i) => {
        d.set(centre.subarray(3 * i, 3 * i + 3), o);
        d[o + 3] = word(splats.colour, i);
      }),
      shape: words(splats.count, (d, o, i) => {
        d[o] = (scale[3 * i] | scale[3 * i + 1] << 16) >>> 0;
        d[o + 1] = scale[3 * i + 2];
        d[o + 2] = word(splats.rotation, i);
        d[o + 3] = splats.probability[i];
      }),
      motion: words(splats.count - splats.still, (d, o, i) => {
        for (let k = 0; k < 3; k++) d[o + k] = (motion[6 * i + 2 * k] | motion[6 * i + 2 * k + 1] << 16) >>> 0;
        d[o + 3] = splats.source[i];
      }),
    };
    const rows = Math.max(...Object.values(parts).map(p => p.rows));
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error('more splats than this graphics driver holds');
    const rowsOfOrder = this.sorter.order.length / ROW;
    this.textures = { order: texture(gl, gl.R32UI, ROW, rowsOfOrder, gl.RED_INTEGER, gl.UNSIGNED_INT, this.sorter.order) };
    for (const [name, { data, rows }] of Object.entries(parts)) {
      this.textures[name] = texture(gl, gl.RGBA32UI, ROW, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, data);
    }
    this.frames = new Float32Array(4 * Math.max(1, info.frames.length));
    this.textures.frames = texture(gl, gl.RGBA32F, this.frames.length / 4, 1, gl.RGBA, gl.FLOAT, this.frames);
    const ramp = new Uint8Array(info.ramp.flatMap(c => [...c, 255]));
    this.textures.ramp = texture(gl, gl.RGBA8, info.ramp.length, 1, gl.RGBA, gl.UNSIGNED_BYTE, ramp);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  }

  /** Draws `view` ({camera, time, mode, grow, show}) on `target` ({width, height, ground}); gives the number of splats. */
  draw(view, target) {
    const { gl, at, info } = this, { camera } = view;
    const active = activeFrames(info.frames, view.time, info.compose);
    const forward = [camera.turn[2], camera.turn[5], camera.turn[8]];
    const wish = JSON.stringify([camera.centre, forward, view.time, view.show]);
    if (wish !== this.sortedFor) {
      this.count = this.sorter.sort({ centre: camera.centre, forward }, info.splat.near, active, view.show);
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, this.textures.order);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, Math.ceil(this.count / ROW), gl.RED_INTEGER, gl.UNSIGNED_INT, this.sorter.order);
      active.forEach((a, i) => this.frames.set([a.on, a.forward, a.backward, 0], 4 * i));
      gl.bindTexture(gl.TEXTURE_2D, this.textures.frames);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, this.frames.length / 4, 1, gl.RGBA, gl.FLOAT, this.frames);
      this.sortedFor = wish;
    }
    gl.viewport(0, 0, target.width, target.height);
    gl.clearColor(...target.ground, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.program);
    gl.bindVertexArray(this.vertices);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    Object.entries(this.textures).forEach(([name, t], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, t);
      gl.uniform1i(at[name], unit);
    });
    const { fx, fy, cx, cy, width, height } = camera.lens;
    const margin = 0.3 * 0.5;
    gl.uniform4f(at.lens, -cx / fx - margin * width / fx, -cy / fy - margin * height / fy, (width - cx) / fx + margin * width / fx, (height - cy) / fy + margin * height / fy);
    // Columns of `turn` are the camera's axes; WebGL reads it by columns, which transposes it: world to camera.
    gl.uniformMatrix3fv(at.toCamera, false, camera.turn);
    gl.uniform3fv(at.eye, camera.centre);
    gl.uniform2f(at.focal, fx, fy);
    gl.uniform2f(at.middle, cx, cy);
    gl.uniform2f(at.size, width, height);
    // The low-pass belongs to the pixels that the scene was made from: a larger picture enlarges it too,
    // else gaps open between splats.
    const zoom = Math.max(1, camera.lens.zoom);
    gl.uniform1f(at.lowPass, info.splat.eps2d * zoom * zoom);
    gl.uniform1f(at.grow, view.grow);
    gl.uniform1f(at.most, info.splat.a_max);
    gl.uniform1i(at.still, this.splats.still);
    gl.uniform1i(at.mode, MODES.indexOf(view.mode));
    gl.uniform1i(at.compensate, info.splat.aa ? 1 : 0);
    gl.uniform2f(at.depthRange, Math.log(info.depth.near), Math.log(info.depth.far));
    gl.uniform1f(at.topSpeed, info.top_speed);
    gl.uniform1i(at.count, this.count);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(this.count / BATCH));
    return this.count;
  }
}

function texture(gl, form, width, height, kind, type, data) {
  const t = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, t);
  gl.texImage2D(gl.TEXTURE_2D, 0, form, width, height, 0, kind, type, data);
  for (const [name, value] of [['MIN_FILTER', 'NEAREST'], ['MAG_FILTER', 'NEAREST'], ['WRAP_S', 'CLAMP_TO_EDGE'], ['WRAP_T', 'CLAMP_TO_EDGE']]) {
    gl.texParameteri(gl.TEXTURE_2D, gl['TEXTURE_' + name], gl[value]);
  }
  return t;
}

function link(gl) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error('shader: ' + gl.getShaderInfoLog(shader));
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error('shader: ' + gl.getProgramInfoLog(program));
  return program;
}
