// Cameras. Axes as in the scene file: x right, y down, z forward; `turn` is the rotation camera to world by rows.

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, s = 1) => a.map((v, i) => v + s * b[i]);
const unit = a => { const n = Math.hypot(...a) || 1; return a.map(v => v / n); };
const axis = (turn, k) => [turn[k], turn[3 + k], turn[6 + k]];
const fromAxes = (x, y, z) => [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]];

/** A vector turned about a unit axis. */
function rotate(v, about, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), d = (1 - c) * (about[0] * v[0] + about[1] * v[1] + about[2] * v[2]);
  const w = cross(about, v);
  return v.map((x, i) => c * x + s * w[i] + d * about[i]);
}

/** Rotation as a quaternion w x y z. */
function quaternion(m) {
  const trace = m[0] + m[4] + m[8];
  if (trace > 0) {
    const s = 2 * Math.sqrt(trace + 1);
    return [s / 4, (m[7] - m[5]) / s, (m[2] - m[6]) / s, (m[3] - m[1]) / s];
  }
  const i = m[0] > m[4] ? (m[0] > m[8] ? 0 : 2) : (m[4] > m[8] ? 1 : 2), j = (i + 1) % 3, k = (i + 2) % 3;
  const s = 2 * Math.sqrt(1 + m[4 * i] - m[4 * j] - m[4 * k]);
  const q = [(m[3 * k + j] - m[3 * j + k]) / s, 0, 0, 0];
  q[1 + i] = s / 4;
  q[1 + j] = (m[3 * j + i] + m[3 * i + j]) / s;
  q[1 + k] = (m[3 * k + i] + m[3 * i + k]) / s;
  return q;
}

function turnOf([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

/** Camera to world between two frames; s outside 0..1 goes on with the same motion. */
function between(a, b, s) {
  const p = quaternion(a.turn);
  let q = quaternion(b.turn);
  let cosine = p.reduce((sum, v, i) => sum + v * q[i], 0);
  if (cosine < 0) { q = q.map(v => -v); cosine = -cosine; }
  const angle = Math.acos(Math.min(1, cosine));
  const [u, v] = angle < 1e-6 ? [1 - s, s] : [Math.sin((1 - s) * angle) / Math.sin(angle), Math.sin(s * angle) / Math.sin(angle)];
  return { turn: turnOf(unit(p.map((x, i) => u * x + v * q[i]))), centre: plus(a.centre, plus(b.centre, a.centre, -1), s) };
}

/** The source camera at a time: its place interpolated and carried on, with the lens of the nearer frame. */
function cameraAt(frames, time) {
  if (frames.length === 1) return frames[0];
  let hi = frames.findIndex(f => f.time >= time);
  hi = Math.max(1, hi < 0 ? frames.length - 1 : hi);
  const [a, b] = [frames[hi - 1], frames[hi]];
  const s = (time - a.time) / (b.time - a.time);
  return { ...(s < 0.5 ? a : b), ...between(a, b, s) };
}

/** The lens of a source frame for a picture of another size: it fills the picture. */
function lensFor(frame, width, height) {
  const s = Math.max(width / frame.width, height / frame.height);
  return {
    width, height, zoom: s, fx: frame.fx * s, fy: frame.fy * s,
    cx: width / 2 + (frame.cx - frame.width / 2) * s, cy: height / 2 + (frame.cy - frame.height / 2) * s,
  };
}

/** The camera that the user moves. */
class Rig {
  constructor(frames, distance) {
    this.frames = frames;
    /** Scene units to the point that orbiting turns about. */
    this.reach = distance;
    this.home = distance;
    this.go(0);
  }

  /** To the camera of a source frame. */
  go(index) {
    const f = this.frames[index];
    this.set(f);
  }

  set({ turn, centre }) {
    this.turn = [...turn];
    this.centre = [...centre];
    this.reach = this.home;
  }

  /** Keeps the horizon: sideways turns go about the scene's vertical. */
  turnBy(yaw, pitch, pivot) {
    const down = unit(axis(this.frames[0].turn, 1));
    const before = pivot ? plus(this.centre, axis(this.turn, 2), this.reach) : null;
    const about = (vectors, a, angle) => vectors.map(v => rotate(v, a, angle));
    let axes = about([0, 1, 2].map(k => axis(this.turn, k)), down, yaw);
    axes = about(axes, axes[0], pitch);
    const z = unit(axes[2]), x = unit(cross(axes[1], z));
    this.turn = fromAxes(x, cross(z, x), z);
    if (before) this.centre = plus(before, z, -this.reach);
  }

  /** Moves in its own axes, scene units. */
  move(x, y, z) {
    for (const [k, d] of [x, y, z].entries()) this.centre = plus(this.centre, axis(this.turn, k), d);
  }

  /** Approaches the point ahead by a factor. */
  approach(factor) {
    const next = Math.min(1e4, Math.max(0.02 * this.home, this.reach * factor));
    this.move(0, 0, this.reach - next);
    this.reach = next;
  }
}
