// The robot of explore.html in 3D, on a canvas: convex bodies by painter's algorithm.
const look = { azimuth: 2.2, elevation: 0.3, zoom: 1 };
function prepareBody(body) {
  body.vertices = array(body.vertices);
  body.faces = array(body.faces);
  body.middle = [0, 1, 2].map(k => { let s = 0; for (let i = k; i < body.vertices.length; i += 3) s += body.vertices[i]; return 3 * s / body.vertices.length; });
}
function prepareScene(scene) {
  scene.time = array(scene.time);
  scene.bodies = data.bodies;
  const raw = array(scene.poses), count = scene.bodies.length;
  const spot = new Float64Array(12);
  scene.place = (frame, who, b) => {  // rotation by rows, then position, m
    const at = ((frame * 3 + who) * count + b) * 7, [w, x, y, z] = [3, 4, 5, 6].map(k => raw[at + k] / 32767), u = scene.extent / 32767;
    spot.set([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), raw[at] * u, raw[at + 1] * u, raw[at + 2] * u]);
    return spot;
  };
  const moved = (p, v) => [0, 1, 2].map(k => p[3 * k] * v[0] + p[3 * k + 1] * v[1] + p[3 * k + 2] * v[2] + p[9 + k]);
  scene.middle = (frame, who, b) => moved(scene.place(frame, who, b), scene.bodies[b].middle);
  scene.off = (frame, who, b) => { const m = scene.middle(frame, who, b), l = scene.middle(frame, 0, b); return Math.hypot(m[0] - l[0], m[1] - l[1], m[2] - l[2]); };
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  scene.most = 0;
  scene.time.forEach((_, f) => scene.bodies.forEach((body, b) => {
    scene.most = Math.max(scene.most, scene.off(f, 1, b), scene.off(f, 2, b));
    if (scene.floating && f) return;
    const p = scene.place(f, 0, b);
    for (let i = 0; i < body.vertices.length; i += 3)
      moved(p, body.vertices.subarray(i, i + 3)).forEach((v, k) => { low[k] = Math.min(low[k], v); high[k] = Math.max(high[k], v); });
  }));
  scene.centre = low.map((v, k) => (v + high[k]) / 2);
  scene.reach = low.map((v, k) => (high[k] - v) / 2);
  scene.ground = low[2];
  scene.grid = Math.max(...scene.reach, 1e-3) / 2.5;
  scene.home = scene.middle(0, 0, 0);
}
const GRID = 4;  // lines of the ground on each side of the middle
const RAMP = [[132, 164, 190], [237, 174, 73], [209, 73, 91]];
function ramp(share) {
  const s = Math.min(Math.max(share, 0), 1) * 2, k = Math.min(Math.floor(s), 1);
  return RAMP[k].map((v, i) => v + (RAMP[k + 1][i] - v) * (s - k));
}
function paint(canvas, scene, frame, who) {
  const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight, pen = canvas.getContext("2d");
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  pen.scale(ratio, ratio);
  const [ca, sa, ce, se] = [Math.cos(look.azimuth), Math.sin(look.azimuth), Math.cos(look.elevation), Math.sin(look.elevation)];
  const right = [-sa, ca, 0], up = [-se * ca, -se * sa, ce], toward = [ce * ca, ce * sa, se];
  const across = v => v.reduce((sum, c, k) => sum + Math.abs(c) * scene.reach[k], 1e-3);  // half of what the box takes
  const size = look.zoom * 0.48 * Math.min(width / across(right), height / across(up)), here = scene.middle(frame, 0, 0);
  const centre = scene.floating ? scene.centre.map((c, k) => c + here[k] - scene.home[k]) : scene.centre;
  const dot = (v, x, y, z) => v[0] * x + v[1] * y + v[2] * z;
  const ghost = matchMedia("(prefers-color-scheme: dark)").matches ? [92, 99, 108] : [196, 201, 207];
  const put = (x, y, z) => [width / 2 + size * dot(right, x, y, z), height / 2 - size * dot(up, x, y, z), size * dot(toward, x, y, z)];
  pen.strokeStyle = css("--line");
  pen.beginPath();
  for (const k of [0, 1]) for (let n = -GRID; n <= GRID; n++) {  // the ground, fixed in the world
    const across = (Math.round(centre[k] / scene.grid) + n) * scene.grid - centre[k], z = scene.ground - centre[2];
    for (const [end, to] of [[-1, "moveTo"], [1, "lineTo"]]) {
      const along = end * GRID * scene.grid, [x, y] = put(...(k ? [along, across, z] : [across, along, z]));
      pen[to](x, y);
    }
  }
  pen.stroke();
  let worst = 0;
  for (const robot of [0, who]) {
    const faces = [];
    scene.bodies.forEach((body, b) => {
      const off = robot ? scene.off(frame, robot, b) : 0, colour = robot ? ramp(off / Math.max(scene.most, 1e-9)) : ghost;
      worst = Math.max(worst, off);
      const p = scene.place(frame, robot, b), points = [];
      for (let i = 0; i < body.vertices.length; i += 3) {
        const [vx, vy, vz] = body.vertices.subarray(i, i + 3);
        const [x, y, z] = [0, 1, 2].map(k => p[3 * k] * vx + p[3 * k + 1] * vy + p[3 * k + 2] * vz + p[9 + k] - centre[k]);
        points.push(put(x, y, z));
      }
      for (let i = 0; i < body.faces.length; i += 3) {
        const [a, c, d] = [0, 1, 2].map(k => points[body.faces[i + k]]);
        const u = [c[0] - a[0], a[1] - c[1], c[2] - a[2]], v = [d[0] - a[0], a[1] - d[1], d[2] - a[2]];
        const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        if (n[2] <= 0) continue;  // seen from behind
        const light = 0.55 + 0.45 * Math.max(0, (0.35 * n[0] + 0.6 * n[1] + 0.72 * n[2]) / Math.hypot(...n));
        faces.push([a[2] + c[2] + d[2], a, c, d, colour, light]);
      }
    });
    pen.globalAlpha = robot ? 0.88 : 1;
    for (const [, a, c, d, colour, light] of faces.sort((f, g) => f[0] - g[0])) {
      pen.fillStyle = pen.strokeStyle = `rgb(${colour.map(v => Math.round(v * light)).join()})`;
      pen.lineWidth = 0.5;
      pen.beginPath();
      pen.moveTo(a[0], a[1]); pen.lineTo(c[0], c[1]); pen.lineTo(d[0], d[1]);
      pen.closePath();
      pen.fill();
      pen.stroke();
    }
  }
  return worst;
}
function robots() {
  const scene = episode().scene, ends = [data.models[0], data.models[data.models.length - 1]];
  $("robots").hidden = !scene;
  if (!scene) return;
  const frame = sample(scene.time, state.time);
  [...$("robots").querySelectorAll("figure")].forEach((figure, k) => {
    const worst = paint(figure.querySelector("canvas"), scene, frame, k + 1);
    figure.querySelector("figcaption").textContent = `${ends[k]}: ${si(worst, "m", 2)} off at most`;
  });
  $("ramp").style.background = `linear-gradient(90deg, ${RAMP.map(c => `rgb(${c})`).join()})`;
  $("most").textContent = si(scene.most, "m", 2);
  $("base").hidden = !scene.floating;
}
function turnable(canvas) {
  let from = null;
  canvas.onpointerdown = event => { from = event; canvas.setPointerCapture(event.pointerId); };
  canvas.onpointerup = canvas.onpointercancel = () => (from = null);
  canvas.onpointermove = event => {
    if (!from) return;
    look.azimuth -= (event.clientX - from.clientX) / 120;
    look.elevation = Math.min(Math.max(look.elevation + (event.clientY - from.clientY) / 120, -1.5), 1.5);
    from = event;
    requestAnimationFrame(robots);
  };
}
