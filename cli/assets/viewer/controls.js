// Pointer, touch and keyboard: each turns into moves of the rig.

/** Calls `moved()` when the camera was moved by hand. */
function pointerControls(canvas, rig, moved) {
  const pointers = new Map();
  canvas.addEventListener('contextmenu', e => e.preventDefault());
  canvas.addEventListener('pointerdown', e => {
    canvas.setPointerCapture(e.pointerId);
    canvas.focus({ preventScroll: true });
    pointers.set(e.pointerId, { x: e.clientX, y: e.clientY, button: e.button });
  });
  const done = e => pointers.delete(e.pointerId);
  canvas.addEventListener('pointerup', done);
  canvas.addEventListener('pointercancel', done);
  canvas.addEventListener('pointermove', e => {
    const p = pointers.get(e.pointerId);
    if (!p) return;
    const span = () => {
      const [a, b] = [...pointers.values()];
      return { size: Math.hypot(a.x - b.x, a.y - b.y), x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 };
    };
    const dx = e.clientX - p.x, dy = e.clientY - p.y, scale = 1 / canvas.clientHeight;
    if (pointers.size === 2) {
      const before = span();
      p.x = e.clientX;
      p.y = e.clientY;
      const after = span();
      rig.approach(before.size / Math.max(1, after.size));
      rig.move((before.x - after.x) * scale * rig.reach, (before.y - after.y) * scale * rig.reach, 0);
    } else if (pointers.size === 1) {
      p.x = e.clientX;
      p.y = e.clientY;
      if (e.shiftKey || p.button === 1) rig.move(-dx * scale * rig.reach, -dy * scale * rig.reach, 0);
      else if (p.button === 2) rig.turnBy(dx * scale * 1.6, -dy * scale * 1.6, false);
      else rig.turnBy(dx * scale * 2.4, -dy * scale * 2.4, true);
    }
    moved();
  });
  canvas.addEventListener('wheel', e => {
    e.preventDefault();
    rig.approach(Math.exp(Math.max(-60, Math.min(60, e.deltaY)) * 0.0022));
    moved();
  }, { passive: false });
}

/** Keys that are held: flies `rig` for `seconds`; whether it moved. */
class Flight {
  constructor() {
    this.held = new Set();
    this.ways = { KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyQ: [0, 1, 0], KeyE: [0, -1, 0], KeyW: [0, 0, 1], KeyS: [0, 0, -1] };
    addEventListener('keydown', e => {
      if (e.code in this.ways && !e.ctrlKey && !e.metaKey && !e.altKey) this.held.add(e.code);
    });
    addEventListener('keyup', e => this.held.delete(e.code));
    addEventListener('blur', () => this.held.clear());
  }

  step(rig, seconds) {
    // A third of the distance to what is seen, in a second.
    const speed = 0.35 * rig.home * Math.min(0.1, seconds);
    for (const code of this.held) rig.move(...this.ways[code].map(v => v * speed));
    return this.held.size > 0;
  }
}
