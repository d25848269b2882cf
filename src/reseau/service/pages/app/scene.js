// Cameras and target in space, drawn on a canvas; turned by dragging, by keys, or by buttons.
const STEP = Math.PI / 18;

function minus(a, b) { return a.map((v, k) => v - b[k]); }
function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

for (const place of document.querySelectorAll('[data-scene]')) show(place);

async function show(place) {
  const canvas = place.querySelector('canvas'), words = place.querySelector('output');
  const answer = await fetch(place.dataset.scene);
  if (!answer.ok) { words.textContent = 'cannot be fetched'; return; }
  const scene = await answer.json();
  const everything = [...scene.xyz, ...scene.cameras.map(c => c.position)];
  const low = [0, 1, 2].map(k => Math.min(...everything.map(p => p[k])));
  const high = [0, 1, 2].map(k => Math.max(...everything.map(p => p[k])));
  const centre = low.map((v, k) => (v + high[k]) / 2);
  const radius = Math.max(...everything.map(p => Math.hypot(...minus(p, centre)))) || 1;
  const size = 0.12 * radius;
  let azimuth = 0.6, height = 0.5, near = 1;
  words.textContent = `${scene.cameras.length} images, ${scene.xyz.length} points.`;

  // Each camera is a pyramid from its projection centre to the corners of its image.
  const lines = [];
  for (const camera of scene.cameras) {
    const [right, down, forward] = camera.axes;
    const corner = (u, v) => camera.position.map((p, k) => p + size * (forward[k] + u * camera.field[0] * right[k] + v * camera.field[1] * down[k]));
    const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    corners.forEach((p, k) => { lines.push([camera.position, p]); lines.push([p, corners[(k + 1) % 4]]); });
  }

  function draw() {
    const box = canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    canvas.width = Math.max(1, Math.round(box.width * ratio));
    canvas.height = Math.max(1, Math.round(box.height * ratio));
    const pen = canvas.getContext('2d'), style = getComputedStyle(canvas);
    const of = name => style.getPropertyValue(name).trim();
    pen.scale(ratio, ratio);
    const right = [-Math.sin(azimuth), Math.cos(azimuth), 0];
    const toward = [Math.cos(height) * Math.cos(azimuth), Math.cos(height) * Math.sin(azimuth), Math.sin(height)];
    const up = [-Math.sin(height) * Math.cos(azimuth), -Math.sin(height) * Math.sin(azimuth), Math.cos(height)];
    const scale = 0.46 * near * Math.min(box.width, box.height) / radius;
    const at = p => {
      const d = minus(p, centre), depth = 1 + 0.25 * dot(d, toward) / radius;
      return [box.width / 2 + scale * depth * dot(d, right), box.height / 2 - scale * depth * dot(d, up), depth];
    };
    pen.clearRect(0, 0, box.width, box.height);
    pen.fillStyle = of('--soft');
    for (const p of scene.xyz) {
      const [x, y, depth] = at(p), r = 1.1 * depth;
      pen.fillRect(x - r, y - r, 2 * r, 2 * r);
    }
    pen.strokeStyle = of('--link');
    pen.lineWidth = 1.2;
    pen.beginPath();
    for (const [a, b] of lines) { pen.moveTo(...at(a).slice(0, 2)); pen.lineTo(...at(b).slice(0, 2)); }
    pen.stroke();
    pen.fillStyle = of('--ink');
    pen.font = '12px system-ui, sans-serif';
    if (scene.cameras.length <= 40) for (const c of scene.cameras) pen.fillText(c.name, at(c.position)[0] + 6, at(c.position)[1] - 6);
    // The axes of the object, a tenth of the scene long, at the origin of its coordinates.
    for (const [k, name] of ['X', 'Y', 'Z'].entries()) {
      const end = [0, 0, 0];
      end[k] = 0.2 * radius;
      const [x0, y0] = at([0, 0, 0]), [x, y] = at(end);
      pen.strokeStyle = of('--bad');
      pen.beginPath();
      pen.moveTo(x0, y0);
      pen.lineTo(x, y);
      pen.stroke();
      pen.fillStyle = of('--bad');
      pen.fillText(name, x + 3, y);
    }
    canvas.dataset.view = `${Math.round(azimuth * 180 / Math.PI)} ${Math.round(height * 180 / Math.PI)} ${near.toFixed(2)}`;
  }

  function turn(how) {
    if (how === 'left') azimuth -= STEP;
    else if (how === 'right') azimuth += STEP;
    else if (how === 'up') height = Math.min(Math.PI / 2, height + STEP);
    else if (how === 'down') height = Math.max(-Math.PI / 2, height - STEP);
    else if (how === 'in') near = Math.min(20, near * 1.25);
    else if (how === 'out') near = Math.max(0.2, near / 1.25);
    else if (how === 'top') { azimuth = -Math.PI / 2; height = Math.PI / 2; }
    else if (how === 'front') { azimuth = -Math.PI / 2; height = 0; }
    else return false;
    requestAnimationFrame(draw);
    return true;
  }

  const keys = {ArrowLeft: 'left', ArrowRight: 'right', ArrowUp: 'up', ArrowDown: 'down', '+': 'in', '=': 'in', '-': 'out'};
  canvas.addEventListener('keydown', event => { if (!event.ctrlKey && !event.metaKey && turn(keys[event.key])) event.preventDefault(); });
  for (const button of place.querySelectorAll('[data-turn]')) button.addEventListener('click', () => turn(button.dataset.turn));
  canvas.addEventListener('pointerdown', event => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener('pointermove', event => {
    if (!canvas.hasPointerCapture(event.pointerId)) return;
    azimuth -= event.movementX / 150;
    height = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, height + event.movementY / 150));
    requestAnimationFrame(draw);
  });
  canvas.addEventListener('wheel', event => { event.preventDefault(); turn(event.deltaY < 0 ? 'in' : 'out'); }, {passive: false});
  new ResizeObserver(() => requestAnimationFrame(draw)).observe(canvas);
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => requestAnimationFrame(draw));
  draw();
}
