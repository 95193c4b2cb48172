// Self-tests, asked for in the address: #check compares with the pictures that the page carries, #bench=N times
// N pictures. Both write JSON into #report, where a script reads it.

/** PSNR in dB of RGBA bytes, alpha ignored. */
function psnr(a, b) {
  let sum = 0;
  for (let i = 0; i < a.length; i++) if (i % 4 < 3) sum += (a[i] - b[i]) ** 2;
  return sum ? 10 * Math.log10(255 ** 2 / (sum / (0.75 * a.length))) : 99;
}

/** Draws at a source frame's size into memory, rows from the top; a view is a source camera with its lens. */
function shoot(drawer, view, size) {
  const { gl } = drawer, { width, height } = size;
  const target = gl.createFramebuffer(), t = texture(gl, gl.RGBA8, width, height, gl.RGBA, gl.UNSIGNED_BYTE, null);
  gl.bindFramebuffer(gl.FRAMEBUFFER, target);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, t, 0);
  const camera = { turn: view.turn, centre: view.centre, lens: lensFor(view, width, height) };
  const show = { still: true, moving: true };
  drawer.draw({ camera, time: view.time, mode: view.mode || 'rgb', grow: 1, show }, { width, height, ground: [0, 0, 0] });
  const raw = new Uint8Array(4 * width * height), upright = new Uint8Array(raw.length);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, raw);
  for (let y = 0; y < height; y++) upright.set(raw.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.deleteFramebuffer(target);
  gl.deleteTexture(t);
  return upright;
}

async function check(drawer) {
  const size = info.frames[0], result = { error: drawer.gl.getError(), pictures: [], modes: {} };
  for (const picture of info.pictures) {
    const image = new Image();
    image.src = 'data:image/jpeg;base64,' + picture.rendered;
    await image.decode();
    const sheet = Object.assign(document.createElement('canvas'), { width: size.width, height: size.height }).getContext('2d');
    sheet.drawImage(image, 0, 0, size.width, size.height);
    const wanted = sheet.getImageData(0, 0, size.width, size.height).data;
    const pose = picture.frame === null ? cameraAt(info.frames, picture.time) : info.frames[picture.frame];
    const got = shoot(drawer, { ...pose, time: picture.time }, size);
    const lit = got.filter((v, i) => i % 4 < 3 && v > 8).length / (0.75 * got.length);
    result.pictures.push({ time: picture.time, psnr_db: +psnr(got, wanted).toFixed(2), lit: +lit.toFixed(3) });
  }
  // From one place at two times: only what moves may differ.
  const from = time => shoot(drawer, { ...info.frames[0], time }, size);
  const [a, b] = [from(first), from(first + 0.4 * (info.time.to - first))];
  result.moved_share = +(a.filter((v, i) => i % 4 < 3 && Math.abs(v - b[i]) > 16).length / (0.75 * a.length)).toFixed(4);
  for (const mode of MODES) {
    const p = shoot(drawer, { ...info.frames[0], time: first, mode }, size);
    result.modes[mode] = +psnr(p, a).toFixed(2);
  }
  result.error = result.error || drawer.gl.getError();
  state.changed = true;
  $('report').textContent = JSON.stringify(result);
}

/** Times whole pictures, sorting included, each finished before the next. */
function bench(drawer, view, canvas, count) {
  const { gl } = drawer, pixel = new Uint8Array(4), times = [];
  const target = { width: canvas.width, height: canvas.height, ground: [0, 0, 0] };
  for (let i = 0; i <= count; i++) {
    const begin = performance.now();
    drawer.draw({ ...view(), time: first + (info.time.to - first) * i / count }, target);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    if (i) times.push(performance.now() - begin);
  }
  const sorted = performance.now();
  for (let i = 0; i < 10; i++) {
    drawer.sorter.sort({ centre: [0, 0, i * 1e-3], forward: [0, 0, 1] }, info.splat.near, activeFrames(info.frames, first, info.compose), state.show);
  }
  const sort_ms = (performance.now() - sorted) / 10;
  drawer.sortedFor = '';
  times.sort((x, y) => x - y);
  const p50 = times[times.length >> 1];
  $('report').textContent = JSON.stringify({ width: canvas.width, height: canvas.height, pictures: count, p50_ms: +p50.toFixed(1), pictures_per_s: +(1000 / p50).toFixed(1), sort_ms: +sort_ms.toFixed(2), driver: String(gl.getParameter(gl.VERSION)) });
}
