// The scene: its numbers out of the page, what exists at a time, and the order to draw it in.

/** Bytes of a base64 text. */
function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

/** Half-precision bits as a number. */
function half(bits) {
  const exponent = (bits >> 10) & 31, fraction = bits & 1023;
  const size = exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -24 * fraction;
  return bits & 0x8000 ? -size : size;
}

/**
 * Splats as the page holds them, the static ones first. Sections in this order, each padded to 4 bytes:
 * centre f32 x 3, scale f16 x 3, rotation i8 x 4 (w x y z), colour and opacity u8 x 4, dynamic probability u8;
 * for moving ones also v+ and v- f16 x 6 and the source frame u16.
 */
function readSplats(info, bytes) {
  const n = info.static + info.moving, m = info.moving;
  let at = 0;
  const section = (Kind, count) => {
    const part = new Kind(bytes.buffer, at, count);
    at += (count * Kind.BYTES_PER_ELEMENT + 3) & ~3;
    return part;
  };
  const splats = {
    count: n,
    still: info.static,
    centre: section(Float32Array, 3 * n),
    scale: section(Uint16Array, 3 * n),
    rotation: section(Uint8Array, 4 * n),
    colour: section(Uint8Array, 4 * n),
    probability: section(Uint8Array, n),
    motion: section(Uint16Array, 6 * m),
    source: section(Uint16Array, m),
  };
  if (at !== bytes.length) throw new Error(`${bytes.length} bytes of splats; ${at} are wanted`);
  splats.velocity = Float32Array.from(splats.motion, half);
  return splats;
}

/**
 * Which frames' moving splats exist at a time, and for how many seconds each follows v+ and v-:
 * `[{on, forward, backward}]`, one per frame. The rules are those of the scene file.
 */
function activeFrames(frames, time, rules) {
  const n = frames.length, same = 1e-6;
  const list = frames.map(() => ({ on: 0, forward: 0, backward: 0 }));
  const own = frames.findIndex(f => Math.abs(f.time - time) <= same);
  const before = frames.filter(f => f.time < time - same).length;
  const neighbours = rules.own === 'neighbours' && n > 1;
  let lo = Math.max(0, before - rules.window), hi = Math.min(n, before + rules.window);
  if (own >= 0) [lo, hi] = neighbours ? [Math.max(0, own - rules.window), Math.min(n, own + rules.window + 1)] : [own, own + 1];
  for (let f = lo; f < hi; f++) {
    if (f === own && neighbours) continue;
    const dt = time - frames[f].time, mirror = rules.extrapolate === 'mirror' && n > 1;
    const entry = list[f];
    entry.on = 1;
    if (f === own) continue;
    // The last frame has no trained forward direction, the first no backward one.
    if (dt > 0) { if (f === n - 1 && mirror) entry.backward = -dt; else entry.forward = dt; }
    else if (f === 0 && mirror) entry.forward = dt;
    else entry.backward = -dt;
  }
  return list;
}

/** Sorts what exists at a time far to near by counting; keys are the upper 16 bits of a positive float's range. */
class Sorter {
  constructor(splats) {
    this.splats = splats;
    // Whole rows of the texture that takes it.
    this.order = new Uint32Array(Math.max(1, Math.ceil(splats.count / 2048)) * 2048);
    this.kept = new Uint32Array(splats.count);
    this.keys = new Uint16Array(splats.count);
    this.start = new Uint32Array(65537);
    this.float = new Float32Array(1);
    this.bits = new Uint32Array(this.float.buffer);
  }

  /** `eye`: centre and forward axis of the camera. Gives how many entries of `order` are to be drawn. */
  sort(eye, near, active, show) {
    const { splats, order, kept, keys, start, float, bits } = this;
    const { centre, velocity, source, still, count } = splats;
    const [fx, fy, fz] = eye.forward, offset = fx * eye.centre[0] + fy * eye.centre[1] + fz * eye.centre[2];
    // 24 octaves from 2^-7 on, 2048 steps each.
    const lowest = 120 << 23;
    let n = 0;
    start.fill(0);
    const put = (i, z) => {
      if (!(z >= near)) return;
      float[0] = z;
      const key = 65535 - Math.min(65535, Math.max(0, (bits[0] - lowest) >> 12));
      kept[n] = i;
      keys[n++] = key;
      start[key + 1]++;
    };
    if (show.still) {
      for (let i = 0, p = 0; i < still; i++, p += 3) put(i, fx * centre[p] + fy * centre[p + 1] + fz * centre[p + 2] - offset);
    }
    if (show.moving) {
      for (let i = still, p = 3 * still, q = 0, m = 0; i < count; i++, p += 3, q += 6, m++) {
        const a = active[source[m]];
        if (!a.on) continue;
        const x = centre[p] + a.forward * velocity[q] + a.backward * velocity[q + 3];
        const y = centre[p + 1] + a.forward * velocity[q + 1] + a.backward * velocity[q + 4];
        const z = centre[p + 2] + a.forward * velocity[q + 2] + a.backward * velocity[q + 5];
        put(i, fx * x + fy * y + fz * z - offset);
      }
    }
    for (let k = 0; k < 65536; k++) start[k + 1] += start[k];
    for (let j = 0; j < n; j++) order[start[keys[j]]++] = kept[j];
    return n;
  }
}
