// The page: state, what is on screen, and the loop that draws when something changed.

const $ = id => document.getElementById(id);
const info = JSON.parse($('scene').textContent);
for (const f of info.frames) {
  const m = f.camera_to_world;
  f.turn = [0, 1, 2].flatMap(i => m[i].slice(0, 3));
  f.centre = [0, 1, 2].map(i => m[i][3]);
}
const first = info.frames[0].time, last = info.frames.at(-1).time;
/** What is asked for after `#` in the address. */
const wish = new URLSearchParams(location.hash.slice(1));
const state = {
  time: first, mode: 'rgb', ride: false, playing: false, speed: 1, grow: 1, show: { still: true, moving: true }, changed: true,
};
const rig = new Rig(info.frames, info.depth.typical);
const seconds = t => t.toFixed(2) + ' s';

function message(title, text) {
  $('message').querySelector('h2').textContent = title;
  $('message').querySelector('p').textContent = text;
  $('message').hidden = false;
}

function setTime(t) {
  state.time = Math.min(info.time.to, Math.max(info.time.from, t));
  state.changed = true;
}

function setMode(mode) {
  state.mode = MODES.includes(mode) ? mode : 'rgb';
  state.changed = true;
  for (const b of $('modes').children) b.setAttribute('aria-checked', String(b.dataset.mode === state.mode));
  legend();
}

function goTo(index, time = info.frames[index].time) {
  state.ride = false;
  state.playing = false;
  rig.go(index);
  setTime(time);
}

/** Draws the scale of the colours. */
function legend() {
  const box = $('legend'), key = $('key'), text = $('key-text');
  box.hidden = state.mode === 'rgb';
  if (box.hidden) return;
  const g = key.getContext('2d'), say = (...parts) => text.replaceChildren(...parts.map(p => Object.assign(document.createElement('span'), { textContent: p })));
  key.classList.toggle('wheel', state.mode === 'velocity');
  if (state.mode === 'velocity') {
    key.width = key.height = 192;
    const image = g.createImageData(192, 192);
    for (let y = 0; y < 192; y++) for (let x = 0; x < 192; x++) {
      const u = (x - 95.5) / 95, v = (95.5 - y) / 95, r = Math.hypot(u, v), h = ((Math.atan2(v, u) / (2 * Math.PI) + 1) % 1) * 6;
      [0, 4, 2].forEach((shift, c) => {
        const pure = Math.min(1, Math.max(0, Math.abs((h + shift) % 6 - 3) - 1));
        image.data[4 * (192 * y + x) + c] = 255 * (1 - Math.min(1, r) * (1 - pure));
      });
      image.data[4 * (192 * y + x) + 3] = r > 1 ? 0 : 255;
    }
    g.putImageData(image, 0, 0);
    say(`up is ahead, rim is ${info.top_speed.toPrecision(2)} units/s`);
    return;
  }
  [key.width, key.height] = [408, 22];
  for (let x = 0; x < key.width; x++) {
    const s = x / (key.width - 1), c = info.ramp[Math.round(s * (info.ramp.length - 1))];
    const still = [15 + 115 * 0.5, 15 + 115 * 0.5, 15 + 115 * 0.5], moves = [255, 140, 41];
    g.fillStyle = `rgb(${state.mode === 'depth' ? c : still.map((v, i) => v + (moves[i] - v) * s)})`;
    g.fillRect(x, 0, 1, key.height);
  }
  if (state.mode === 'dynamic') { say('static', 'moving'); return; }
  const { near, far } = info.depth, at = s => near * (far / near) ** s;
  const short = v => v < 10 ? v.toPrecision(2).replace(/\.0$/, '') : v.toFixed(0);
  say(...[0, 0.25, 0.5, 0.75, 1].map(s => short(at(s)) + (s === 1 ? ' units' : '')));
}

/** Everything that does not need WebGL. */
function buildPage() {
  $('title').textContent = info.title;
  $('counts').textContent = `${(info.static + info.moving).toLocaleString('en')} splats, ${info.frames.length} source frame${info.frames.length > 1 ? 's' : ''}`;
  $('count-static').textContent = info.static.toLocaleString('en');
  $('count-moving').textContent = info.moving.toLocaleString('en');
  info.frames.forEach((f, i) => {
    const b = document.createElement('button');
    b.textContent = i + 1;
    b.title = `Camera of source frame ${i + 1}, ${seconds(f.time)}`;
    b.onclick = () => goTo(i);
    $('frames').append(b);
  });
  for (const b of $('modes').children) b.onclick = () => setMode(b.dataset.mode);
  $('ride').onchange = e => { state.ride = e.target.checked; state.changed = true; };
  $('show-static').onchange = e => { state.show.still = e.target.checked; state.changed = true; };
  $('show-moving').onchange = e => { state.show.moving = e.target.checked; state.changed = true; };
  $('size').oninput = e => { state.grow = +e.target.value; state.changed = true; };
  $('menu').onclick = () => {
    const open = getComputedStyle($('panel')).display === 'none';
    document.documentElement.dataset.panel = open ? 'on' : 'off';
    $('menu').setAttribute('aria-expanded', String(open));
  };
  $('play').onclick = togglePlay;
  $('speed').onchange = e => { state.speed = +e.target.value; };
  const slider = $('time'), span = info.time.to - info.time.from;
  [slider.min, slider.max] = [info.time.from, info.time.to];
  slider.oninput = () => { state.playing = false; setTime(+slider.value); };
  const percent = t => span > 0 ? `${100 * (t - info.time.from) / span}%` : '0%';
  for (const f of info.frames) {
    const tick = document.createElement('i');
    tick.style.left = percent(f.time);
    $('ticks').append(tick);
  }
  if (info.time.to > last) {
    const beyond = document.createElement('u');
    beyond.style.left = percent(last);
    beyond.style.right = '0';
    beyond.title = 'beyond the last source frame: extrapolated';
    $('ticks').append(beyond);
  }
  info.pictures.forEach(buildCard);
}

/** One real picture beside the rendered one; the line between them follows the pointer. */
function buildCard(picture) {
  const card = document.createElement('button');
  card.className = 'card';
  const pair = Object.assign(document.createElement('span'), { className: 'pair' });
  const add = (source, side, word) => {
    if (!source) return;
    pair.append(Object.assign(new Image(), { src: 'data:image/jpeg;base64,' + source, alt: word, draggable: false }));
  };
  add(picture.real, 'left', 'real');
  add(picture.rendered, 'right', 'rendered');
  const words = picture.real ? [['left', 'real'], ['right', 'rendered']] : [['right', 'rendered']];
  for (const [side, word] of words) pair.append(Object.assign(document.createElement('span'), { className: side, textContent: word }));
  if (picture.real) {
    pair.classList.add('both');
    card.onpointermove = e => {
      const r = pair.getBoundingClientRect();
      pair.style.setProperty('--at', `${100 * Math.min(1, Math.max(0, (e.clientX - r.left) / r.width))}%`);
    };
    card.onpointerleave = () => pair.style.removeProperty('--at');
  }
  const caption = Object.assign(document.createElement('span'), { className: 'caption' });
  const name = picture.frame === null ? seconds(picture.time) : `${picture.frame + 1}: ${seconds(picture.time)}`;
  card.title = picture.frame !== null ? `Source frame ${picture.frame + 1}` : `Never seen by the network: ${picture.time > last ? 'beyond the last' : 'between two'} source frame${picture.time > last ? '' : 's'}`;
  caption.append(Object.assign(document.createElement('b'), { textContent: name }));
  if (picture.psnr_db !== null) caption.append(Object.assign(document.createElement('span'), { textContent: `${picture.psnr_db.toFixed(1)} dB`, title: 'PSNR of the rendered picture' }));
  card.append(pair, caption);
  card.onclick = () => {
    if (picture.frame !== null) { goTo(picture.frame); return; }
    goTo(0, picture.time);
    rig.set(cameraAt(info.frames, picture.time));
  };
  card.dataset.time = picture.time;
  $('strip').append(card);
}

function togglePlay() {
  state.playing = !state.playing;
  if (state.playing && state.time >= info.time.to) setTime(info.time.from);
  state.changed = true;
}

function keyControls() {
  addEventListener('keydown', e => {
    if (e.ctrlKey || e.metaKey || e.altKey || e.target.matches('select, input[type="range"]')) return;
    if (e.code === 'Space' && e.target.matches('button, input, summary')) return;
    const step = (last - first || 1) / Math.max(1, info.frames.length - 1) / 5;
    const actions = {
      Space: togglePlay,
      ArrowLeft: () => { state.playing = false; setTime(state.time - step); },
      ArrowRight: () => { state.playing = false; setTime(state.time + step); },
      KeyC: () => setMode(MODES[(MODES.indexOf(state.mode) + 1) % MODES.length]),
      KeyF: () => { state.ride = !state.ride; state.changed = true; },
      KeyR: () => goTo(0),
      KeyH: () => { const d = document.documentElement.dataset; d.ui = d.ui === 'off' ? 'on' : 'off'; },
    };
    const digit = /^(?:Digit|Numpad)([1-9])$/.exec(e.code);
    if (digit && info.frames[digit[1] - 1]) goTo(digit[1] - 1);
    else if (actions[e.code]) actions[e.code]();
    else return;
    e.preventDefault();
  });
}

/** Controls show the state. */
function reflect() {
  $('time').value = state.time;
  const note = state.time > last ? 'extrapolated' : '';
  $('clock').replaceChildren(seconds(state.time), Object.assign(document.createElement('small'), { textContent: note ? ' ' + note : '' }));
  $('play').innerHTML = state.playing ? '&#10073;&#10073;' : '&#9654;';
  $('play').setAttribute('aria-label', state.playing ? 'Pause' : 'Play');
  $('ride').checked = state.ride;
  const here = f => !state.ride && f.centre.every((v, i) => Math.abs(v - rig.centre[i]) < 1e-9) && f.turn.every((v, i) => Math.abs(v - rig.turn[i]) < 1e-9);
  [...$('frames').children].forEach((b, i) => b.setAttribute('aria-pressed', String(here(info.frames[i]))));
  for (const card of $('strip').children) card.setAttribute('aria-pressed', String(Math.abs(card.dataset.time - state.time) < 1e-6));
}

function start() {
  const canvas = $('view');
  const gl = wish.get('webgl') === 'off' ? null
    : canvas.getContext('webgl2', { antialias: false, alpha: false, depth: false, powerPreference: 'high-performance', preserveDrawingBuffer: true });
  if (!gl) {
    document.documentElement.dataset.state = 'no-webgl';
    message('This browser shows no WebGL2', 'The scene in three dimensions needs it: a current Firefox, Chrome, Edge or Safari with hardware acceleration switched on. The pictures below were rendered when this page was made.');
    return;
  }
  const drawer = new Drawer(gl, info, readSplats(info, bytesOf($('splats').textContent.trim())));
  canvas.addEventListener('webglcontextlost', e => {
    e.preventDefault();
    message('The graphics driver gave up', 'Reload the page to see the scene again.');
  });
  const view = () => {
    const { width, height } = canvas;
    const pose = state.ride ? cameraAt(info.frames, state.time) : rig;
    // Every frame may have a focal length of its own, as predicted: riding along shows what was drawn there.
    const lens = lensFor(state.ride ? pose : info.frames[0], width, height);
    return { camera: { turn: pose.turn, centre: pose.centre, lens }, ...state };
  };
  const fit = () => {
    const ratio = Math.min(2, devicePixelRatio || 1);
    const [w, h] = [Math.max(1, Math.round(canvas.clientWidth * ratio)), Math.max(1, Math.round(canvas.clientHeight * ratio))];
    if (canvas.width === w && canvas.height === h) return;
    [canvas.width, canvas.height] = [w, h];
    state.changed = true;
  };
  const ground = [0.055, 0.063, 0.071];
  const draw = () => drawer.draw(view(), { width: canvas.width, height: canvas.height, ground });
  pointerControls(canvas, rig, () => {
    // By hand from where the ride has come to.
    state.ride = false;
    state.changed = true;
  });
  keyControls();
  const flight = new Flight();
  fit();
  let before = performance.now(), rate = 0, drawn = false;
  const loop = now => {
    const dt = (now - before) / 1000;
    before = now;
    if (state.playing) {
      const t = state.time + dt * state.speed;
      setTime(t > info.time.to ? info.time.from : t);
    }
    if (state.ride) Object.assign(rig, { turn: [...view().camera.turn], centre: [...view().camera.centre] });
    if (flight.step(rig, dt)) { state.ride = false; state.changed = true; }
    fit();
    if (state.changed) {
      state.changed = false;
      draw();
      reflect();
      // The first picture after a rest tells nothing about the rate.
      if (drawn && dt > 0) rate = rate ? rate + 0.1 * (1 / dt - rate) : 1 / dt;
      drawn = true;
      $('rate').textContent = rate ? `${rate < 10 ? rate.toFixed(1) : rate.toFixed(0)} pictures/s` : '';
    } else if (drawn) {
      drawn = false;
      rate = 0;
      $('rate').textContent = 'at rest';
    }
    requestAnimationFrame(loop);
  };
  draw();
  reflect();
  document.documentElement.dataset.state = 'ready';
  requestAnimationFrame(loop);
  if (wish.has('bench')) bench(drawer, view, canvas, +wish.get('bench') || 20);
  if (wish.has('check')) check(drawer).catch(e => { $('report').textContent = 'failed: ' + e.message; });
}

/** The address may ask for a moment and a view: #t=0.5&mode=velocity&frame=2&ride=1&play=1&ui=off. */
function obey() {
  if (wish.has('frame')) {
    const i = Math.min(info.frames.length, Math.max(1, +wish.get('frame') || 1)) - 1;
    goTo(i);
  }
  if (wish.has('t')) setTime(+wish.get('t') || 0);
  setMode(wish.get('mode') || 'rgb');
  const number = key => +wish.get(key) || 0;
  rig.move(number('right'), -number('up'), number('forward'));
  if (number('yaw') || number('pitch')) rig.turnBy(number('yaw') * Math.PI / 180, number('pitch') * Math.PI / 180, false);
  state.ride = wish.get('ride') === '1';
  state.playing = wish.get('play') === '1';
  if (wish.get('ui') === 'off') document.documentElement.dataset.ui = 'off';
}

try {
  buildPage();
  obey();
  start();
} catch (e) {
  document.documentElement.dataset.state = 'failed';
  message('The page could not show the scene', e.message);
  throw e;
}
