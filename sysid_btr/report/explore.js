// What explore.html does: one cursor in time over every picture. Data: explore.json.gz (see explore.py) and result.json.
const $ = id => document.getElementById(id);
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
const KINDS = { f4: Float32Array, i2: Int16Array, u2: Uint16Array };
const array = packed => new KINDS[packed.type](bytes(packed.data).buffer);
const SCHEMA = "sysid_btr.explore/2";
const MOST_POINTS = 4000, STRETCHES = 300, NARROW = 600;
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const touch = matchMedia("(pointer: coarse)").matches;  // there a finger on a picture scrolls the page
const narrow = () => innerWidth <= NARROW;

async function unpacked(id) {
  const stream = new Blob([bytes($(id).textContent.trim())]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}

// --- numbers and words ---------------------------------------------------------------------------------------

const PREFIXED = ["rad", "m", "rad/s", "m/s", "Nm", "N", "s"];
function scale(size, unit) {  // [factor, unit] in which numbers of this size read well
  if (!PREFIXED.includes(unit) || !(size > 0)) return [1, unit];
  const [factor, prefix] = [[1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"]].find(([f]) => size >= f * 0.9995) ?? [1e-9, "n"];
  return [factor, prefix + unit];
}
function si(value, unit, digits = 4) {
  if (value === null || value === undefined || !isFinite(value)) return "–";
  const [factor, name] = scale(Math.abs(value), unit);
  return `${shown(value / factor, digits)} ${name}`;
}
function shown(value, digits = 4) {
  if (value === null || value === undefined || value === "") return "";
  if (typeof value !== "number") return String(value).replaceAll("+-", "±").replaceAll("->", "→");
  return isFinite(value) ? String(Number(value.toPrecision(digits))).replace("-", "−") : "–";
}
function digitsOf(value, std) {
  if (value === null || !(std > 0)) return shown(value);
  const decimals = 1 - Math.floor(Math.log10(std));
  return decimals >= 0 && decimals <= 7 ? value.toFixed(decimals).replace("-", "−") : shown(value);
}
const brief = name => (name.length > 36 ? `${name.slice(0, 26)}… (${name.split(",").length})` : name);
function make(tag, text, attributes = {}) {
  const element = Object.assign(document.createElement(tag), attributes);
  if (text !== null) element.textContent = text;
  return element;
}

// --- tables ----------------------------------------------------------------------------------------------------

// columns: [title, key or function of a row, words for it (null: only copied and saved)]; copies have all digits
function table(id, title, note, columns, rows, pick = null) {
  const place = $(id);
  place.replaceChildren();
  if (!rows.length) return;
  const cells = rows.map(row => columns.map(([, key]) => (typeof key === "function" ? key(row) : row[key])));
  const raw = value => (value === null || value === undefined ? "" : String(value));
  const quoted = text => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const lines = (mark, quote) => [columns.map(c => c[0]), ...cells].map(r => r.map(v => quote(raw(v))).join(mark)).join("\n") + "\n";
  const tools = make("span", null, { className: "tools" });
  const copy = make("button", "copy", { title: "for a spreadsheet" }), save = make("button", "CSV");
  copy.onclick = async () => {
    const area = make("textarea", lines("\t", t => t.replaceAll(/\s+/g, " ")));
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    copy.textContent = done ? "copied" : "cannot copy";
    setTimeout(() => (copy.textContent = "copy"), 1500);
  };
  save.onclick = () => {
    const url = URL.createObjectURL(new Blob([lines(",", quoted)], { type: "text/csv" }));
    make("a", "", { href: url, download: `${id}.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  };
  tools.append(copy, save);
  const heading = make("h2", `${title} `);
  heading.append(tools);
  const visible = columns.flatMap(([, , words], k) => (words === null ? [] : [k]));
  const numeric = columns.map((_, k) => cells.some(r => typeof r[k] === "number"));
  const body = make("tbody", null), head = make("tr", null);
  for (const k of visible) head.append(make("th", columns[k][0], { className: numeric[k] ? "n" : "" }));
  cells.forEach((row, i) => {
    const line = make("tr", null, { className: pick ? "pick" : "" });
    for (const k of visible) {
      const words = columns[k][2] ? columns[k][2](rows[i]) : shown(row[k]);
      const cell = make("td", null, { className: numeric[k] ? "n" : words.length > 40 ? "wide" : words.length < 20 ? "u" : "" });
      words.split(/(?<=,)(?=\S)/).forEach((piece, n) => cell.append(...(n ? [make("wbr", null)] : []), piece));
      if (k) cell.dataset.label = columns[k][0];
      line.append(cell);
    }
    if (pick) { line.onclick = () => pick(rows[i]); line.dataset.key = pick.key(rows[i]); }
    body.append(line);
  });
  const thead = make("thead", null), whole = make("table", null), frame = make("div", null, { className: "scroll" });
  thead.append(head);
  whole.append(thead, body);
  frame.append(whole);
  place.append(heading, ...(note ? [make("p", note, { className: "faint" })] : []), frame);
}

// --- what is shown, and when -----------------------------------------------------------------------------------

let data, result;
const state = { episode: 0, channel: "", joint: "", time: 0, playing: false };
const episode = () => data.episodes[state.episode];
const sensors = () => episode().sensors.filter(s => s.channel === state.channel);
const sensor = () => sensors().find(s => s.joint === state.joint) ?? sensors()[0];

function prepare() {
  data.bodies.forEach(prepareBody);
  for (const e of data.episodes) {
    e.time = array(e.time);
    for (const s of e.sensors) {
      s.command = array(s.command);
      s.log = array(s.log);
      s.predicted = s.predicted.map(array);
      s.residual = s.predicted.map(p => s.log.map((v, i) => v - p[i]));
    }
    if (e.scene) prepareScene(e.scene);
  }
}
function sample(times, t) {  // the last sample up to t
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t + 1e-9) low = middle; else high = middle - 1;
  }
  return low;
}

function base(height, more = {}) {
  return {
    height, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", dragmode: touch ? false : "zoom", hoverdistance: -1,
    font: { family: "system-ui, sans-serif", size: narrow() ? 11 : 12, color: css("--ink") },
    margin: { l: narrow() ? 52 : 66, r: 12, t: 34, b: 38 }, ...more,
  };
}
const axis = more => ({ gridcolor: css("--line"), zerolinecolor: css("--line"), linecolor: css("--line"), automargin: false, ...more });
const config = { responsive: true, displayModeBar: false };

// --- the signals of a joint ------------------------------------------------------------------------------------

let range = null;  // s, what is zoomed to
function signals() {
  const s = sensor(), time = episode().time, end = time[time.length - 1];
  const first = range ? sample(time, range[0]) : 0, last = range ? Math.min(sample(time, range[1]) + 2, time.length) : time.length;
  const step = Math.max(Math.floor((last - first) / MOST_POINTS), 1);
  const rows = [];
  for (let i = first; i < last; i += step) rows.push(i);
  const of = (values, factor = 1) => rows.map(i => values[i] / factor);
  const x = of(time), [factor, unit] = scale(Math.max(...s.residual[0].map(v => Math.abs(v) || 0)), s.unit);
  const line = (name, values, color, more = {}) => ({
    name, x, y: values, mode: "lines", line: { color, width: 1.6, ...more.line }, hovertemplate: "%{y:.5g}", ...more.trace });
  const lines = [];
  if (s.channel === "position" && s.command.some(v => isFinite(v)))
    lines.push(line("command", of(s.command), css("--faint"), { line: { width: 1.1, dash: "dash", shape: "hv" } }));
  lines.push(line("log", of(s.log), css("--ink"), { line: { width: 2.2 } }));
  data.models.forEach((name, k) => {
    lines.push(line(name, of(s.predicted[k]), data.colours[k]));
    lines.push(line(`log − ${name}`, of(s.residual[k], factor), data.colours[k], { trace: { yaxis: "y2", showlegend: false } }));
  });
  const rectangle = (more, fillcolor) => ({ type: "rect", layer: "below", line: { width: 0 }, fillcolor, ...more });
  const spans = episode().held_out, held = spans.length > 1 || spans[0][0] > time[0] ? spans : [];
  const layout = base(narrow() ? 430 : 520, {
    hovermode: "x", showlegend: true, uirevision: `${state.episode}`,
    legend: { orientation: "h", x: 0, y: 1.01, yanchor: "bottom", bgcolor: "rgba(0,0,0,0)" },
    margin: { l: narrow() ? 56 : 70, r: 10, t: narrow() ? 62 : 40, b: 38 },
    xaxis: axis({ anchor: "y2", title: { text: "time (s)", standoff: 4 }, range: range ?? [time[0], end] }),
    yaxis: axis({ domain: [0.4, 1], title: { text: `${s.joint} (${s.unit})`, standoff: 6 } }),
    yaxis2: axis({ domain: [0, 0.33], title: { text: `log − model (${unit})`, standoff: 6 } }),
    shapes: [
      ...held.map(([x0, x1]) => rectangle({ xref: "x", yref: "paper", x0, x1, y0: 0, y1: 1 }, "#388bfd24")),
      rectangle({ xref: "paper", yref: "y2", x0: 0, x1: 1, y0: -2 * s.noise / factor, y1: 2 * s.noise / factor }, css("--faint") + "55"),
    ],
    annotations: [
      ...held.slice(0, 1).map(([x]) => ({ text: "held out", xref: "x", yref: "paper", x, y: 1, xanchor: "left", yanchor: "top", showarrow: false, font: { size: 11, color: css("--faint") } })),
      { text: "band: 2 × noise", xref: "paper", yref: "paper", x: 1, y: 0.33, xanchor: "right", yanchor: "bottom", showarrow: false, font: { size: 11, color: css("--faint") } },
    ],
  });
  Plotly.react("signals", lines, layout, config);
}

function readout() {
  const s = sensor(), i = sample(episode().time, state.time);
  const cells = [["at the cursor", "value", "log − model"]];
  if (isFinite(s.command[i])) cells.push(["command", si(s.command[i], s.unit.replace(/N$|Nm$|\/s$/, "")), ""]);
  cells.push(["log", si(s.log[i], s.unit), ""]);
  data.models.forEach((name, k) => cells.push([name, si(s.predicted[k][i], s.unit), si(s.residual[k][i], s.unit, 3)]));
  const colours = { command: css("--faint"), log: css("--ink") };
  data.models.forEach((name, k) => (colours[name] = data.colours[k]));
  $("readout").replaceChildren(...cells.flatMap((row, n) => row.map((text, k) => {
    const cell = make("span", text, { className: n ? "" : "faint" });
    if (n && !k) { const swatch = make("span", null, { className: "swatch" }); swatch.style.background = colours[row[0]]; cell.prepend(swatch); }
    return cell;
  })));
}

// --- where and when --------------------------------------------------------------------------------------------

function where() {
  const time = episode().time, own = sensors(), n = time.length, count = Math.min(STRETCHES, n);
  const x = Array.from({ length: count }, (_, b) => time[Math.floor((b + 0.5) * n / count)]);
  let most = 1;
  const rows = data.models.map((_, k) => own.map(s => x.map((_, b) => {
    let sum = 0, seen = 0;
    for (let i = Math.floor(b * n / count); i < Math.floor((b + 1) * n / count); i++)
      if (isFinite(s.residual[k][i])) { sum += (s.residual[k][i] / s.noise) ** 2; seen++; }
    const value = seen ? Math.sqrt(sum / seen) : NaN;
    if (value > most) most = value;
    return value;
  })));
  const names = own.map(s => s.joint), tall = Math.max(names.length * (narrow() ? 11 : 14), 34), gap = 30;
  const height = 40 + data.models.length * (tall + gap), inner = height - 40;
  const decades = Math.max(Math.ceil(Math.log10(most)), 1);
  const layout = base(height, {
    margin: { l: longest(names), r: 8, t: 4, b: 36 }, hovermode: "closest",
    coloraxis: { cmin: 0, cmax: decades, colorscale: [[0, css("--panel")], [0.35, css("--m1")], [1, css("--m0")]],
      colorbar: { thickness: 10, len: 1, outlinewidth: 0, tickvals: [...Array(decades + 1).keys()],
        ticktext: [...Array(decades + 1).keys()].map(d => (d ? String(10 ** d) : "≤ 1")), title: { text: "× noise", side: "right" } } },
    xaxis: axis({ anchor: `y${data.models.length > 1 ? data.models.length : ""}`, title: { text: "time (s)", standoff: 4 }, range: [time[0], time[n - 1]], showgrid: false }),
    annotations: [],
  });
  const maps = data.models.map((name, k) => {
    const top = 1 - (k * (tall + gap) + gap - 8) / inner, axisName = k ? `yaxis${k + 1}` : "yaxis";
    layout[axisName] = axis({ domain: [Math.max(top - tall / inner, 0), top], autorange: "reversed", fixedrange: true, showgrid: false, tickfont: { size: narrow() ? 9 : 11 }, dtick: 1 });
    layout.annotations.push({ text: name, xref: "paper", yref: "paper", x: 0, y: top, xanchor: "left", yanchor: "bottom", showarrow: false });
    return { type: "heatmap", x, y: names, z: rows[k].map(r => r.map(v => Math.log10(Math.max(v, 1)))), customdata: rows[k],
      yaxis: k ? `y${k + 1}` : "y", coloraxis: "coloraxis", hovertemplate: "%{y}, %{x:.2f} s: %{customdata:.3g} × noise<extra></extra>" };
  });
  Plotly.react("where", maps, layout, config);
}
const longest = names => Math.min(14 + Math.max(...names.map(n => n.length), 3) * (narrow() ? 5.3 : 6.8), narrow() ? 170 : 260);

// --- matrices --------------------------------------------------------------------------------------------------

function matrix(id, rows, columns, values, more) {
  if (!rows.length || !columns.length) { $(id).parentElement.hidden = true; return; }
  const cell = Math.max(Math.min(26, 520 / rows.length), 11), few = columns.length <= (narrow() ? 5 : 9);
  const apart = Math.ceil(columns.length / (narrow() ? 8 : 16)), numbered = columns.map((_, k) => k).filter(k => k % apart === 0);
  const layout = base(cell * rows.length + 70, {
    margin: { l: longest(rows), r: 8, t: 24, b: 8 }, hovermode: "closest",
    xaxis: axis({ side: "top", tickangle: 0, tickvals: numbered, ticktext: numbered.map(k => k + 1), showgrid: false, zeroline: false, tickfont: { size: 10 } }),
    yaxis: axis({ autorange: "reversed", tickvals: rows.map((_, k) => k), ticktext: rows, showgrid: false, zeroline: false, tickfont: { size: narrow() ? 9 : 11 } }),
  });
  const map = { type: "heatmap", z: values.map(r => r.map(v => (v === null ? NaN : more.colour(v)))), xgap: 1, ygap: 1,
    customdata: values.map((r, i) => r.map((v, k) => `${rows[i]}<br>${columns[k]}: ${v === null ? "not known" : more.words(v, k)}`)),
    hovertemplate: "%{customdata}<extra></extra>", colorbar: { thickness: 10, outlinewidth: 0, ...more.bar }, ...more.map };
  if (few) Object.assign(map, { text: values.map(r => r.map(v => (Math.abs(v ?? 0) < 0.1 ? "" : shown(v, 2)))), texttemplate: "%{text}", textfont: { size: 11 } });
  Plotly.react(id, [map], layout, config);
}
function matrices() {
  const estimates = [...result.parameters, ...result.effects.flatMap(e => e.parameters)];
  const names = estimates.map((p, k) => `${brief(p.name)} ${k + 1}`);
  matrix("correlation", names, names, result.correlation ?? [], {
    colour: v => v, words: v => shown(v, 3), bar: { tickvals: [-1, 0, 1] },
    map: { zmin: -1, zmax: 1, colorscale: [[0, "#388bfd"], [0.5, css("--panel")], [1, css("--m0")]] } });
  const moved = result.sensitivity ?? [];
  const places = [...new Set(moved.flatMap(p => Object.keys(p.moves)))];
  const columns = moved.map((p, k) => `${brief(p.name)} by ${shown(p.change, 2)}${p.unit === "1" ? " × nominal" : " " + p.unit}`);
  const values = places.map(place => moved.map(p => p.moves[place] ?? null));
  const most = Math.max(...values.flat().map(v => v ?? 0), 10), top = Math.ceil(Math.log10(most));
  const ticks = Array.from({ length: top + 2 }, (_, k) => k - 1);
  matrix("sensitivity", places, columns, values, {
    colour: v => Math.log10(Math.max(v, 0.1)), words: v => `${shown(v, 3)} × noise`,
    bar: { tickvals: ticks, ticktext: ticks.map(t => (t < 0 ? "≤ 0.1" : String(10 ** t))) },
    map: { zmin: -1, zmax: top, colorscale: [[0, css("--panel")], [1, css("--m2")]] } });
}

// --- tables and the search --------------------------------------------------------------------------------------

const unitOf = p => (p.unit === "1" ? "× nominal" : p.unit);
function tables() {
  const pick = row => select({ episode: row.e, channel: row.s.channel, joint: row.s.joint });
  pick.key = row => `${row.e} ${row.s.channel} ${row.s.joint}`;
  const rows = data.episodes.flatMap((e, k) => e.sensors.map(s => ({ e: k, s, label: e.label })));
  const largest = unit => Math.max(...rows.filter(r => r.s.unit === unit).flatMap(r => r.s.errors));
  const alike = (s, value) => { const [factor, unit] = scale(largest(s.unit), s.unit); return `${shown(value / factor, 3)} ${unit}`; };
  const several = data.episodes.length > 1 ? [["log", "label"]] : [];
  table("errors", "Error of every joint", "Root mean square over what is held out, worst first. A click shows the joint above.",
    [["joint", r => r.s.joint], ...several, ["channel", r => r.s.channel],
      ...data.models.map((m, k) => [m, r => r.s.errors[k], r => alike(r.s, r.s.errors[k])]),
      ["noise floor", r => r.s.noise, r => alike(r.s, r.s.noise)], ["unit", r => r.s.unit, null]], rows, pick);
  const known = p => p.identifiable !== "no" || result.kind === "posterior";
  const like = (p, value) => (known(p) ? digitsOf(value, p.std) : "");  // as many digits as are known
  const estimates = [...result.parameters, ...result.effects.flatMap(e => e.parameters)];
  table("parameters", "Parameters", "", [["parameter", "name"], ["number", p => estimates.indexOf(p) + 1], ["nominal", "nominal"],
    ["value", p => (known(p) ? p.value : null), p => like(p, p.value)], ["std", p => (known(p) ? p.std : null), p => (known(p) ? shown(p.std, 2) : "")],
    ["95 % from", p => (known(p) ? p.ci95[0] : null), p => like(p, p.ci95[0])], ["to", p => (known(p) ? p.ci95[1] : null), p => like(p, p.ci95[1])], ["unit", unitOf], ["identifiable", p => (p.identifiable !== "no" && p.at_bound ? "at its bound" : { yes: "yes", weak: "weakly", no: "no" }[p.identifiable])], ["reason", "reason"]], estimates);
  const percent = v => (v === null || v === undefined ? null : Math.round(1000 * v) / 10);
  table("effects", "What the model lacked", "", [["effect", "effect"], ["where", e => e.where.join(", ")], ["in words", "sentence"], ["certainty, %", e => e.certainty, e => (e.certainty > 0.995 ? "over 99" : e.certainty < 0.005 ? "under 1" : String(Math.round(100 * e.certainty)))],
    ["explains, % of fitted", e => percent(e.explains.train)], ["% of held out", e => percent(e.explains.holdout)], ["confounded with", e => e.confused_with.join(", ")]], result.effects);
  const step = s => [...s.added.map(a => `+ ${a}`), ...s.removed.map(a => `− ${a}`)].join(", ") || "parameters fitted";
  table("steps", "Steps", "chi2: mean square error over that of the noise, 1 at the floor.",
    [["", s => result.steps.indexOf(s) + 1], ["step", step], ["chi2, fitted", "train"], ["chi2, held out", "holdout"]], result.steps);
  table("candidates", "Effects that were considered", "", [["round", "round"], ["effect", "effect"], ["where", c => c.where.join(", ")],
    ["amount", "amplitude"], ["would explain, %", c => percent(c.explained)], ["what became of it", "why"]], result.candidates);
  $("candidates").parentElement.hidden = !result.candidates.length;
}
function search() {
  const history = result.history ?? [], steps = result.steps ?? [];
  const best = (name, y, color, x) => ({ name, x, y, mode: "lines+markers", line: { color, shape: "hv", width: 1.8 }, marker: { size: 6 } });
  let lines = [], titles = ["replays", "best loss"];
  if (steps.length > 1) {
    const x = steps.map((_, k) => k + 1);
    lines = [best("fitted data", steps.map(s => s.train), css("--ink"), x), best("held-out data", steps.map(s => s.holdout), css("--m2"), x)];
    titles = ["step (table below)", "chi2"];
  } else if (history.length > 1) lines = [best("best loss", history.map(h => h.loss), css("--m2"), history.map(h => h.replays))];
  if (!lines.length) { $("course").hidden = !steps.length; $("search").hidden = true; return; }
  const all = lines.flatMap(l => l.y).filter(v => v > 0), wide = Math.max(...all) > 3 * Math.min(...all);
  Plotly.react("search", lines, base(280, {
    xaxis: axis({ title: { text: titles[0], standoff: 4 }, ...(steps.length > 1 ? { dtick: Math.max(Math.ceil(steps.length / 12), 1) } : {}) }),
    yaxis: axis({ title: { text: titles[1], standoff: 6 }, ...(wide ? { type: "log", ...(Math.max(...all) > 30 * Math.min(...all) ? { dtick: 1 } : {}) } : {}) }), hovermode: "x",
    legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom" }, showlegend: lines.length > 1, margin: { l: 70, r: 12, t: 34, b: 42 } }), config);
}

// --- one cursor ---------------------------------------------------------------------------------------------------

function cursors() {
  for (const id of ["signals", "where"]) {
    const plot = $(id), full = plot._fullLayout;
    if (!full) continue;
    let mark = plot.querySelector(":scope > .cursor");
    if (!mark) plot.append(mark = make("div", null, { className: "cursor" }));
    const x = full.xaxis.l2p(state.time), inside = x >= -0.5 && x <= full.xaxis._length + 0.5;
    Object.assign(mark.style, { display: inside ? "block" : "none", left: `${full.xaxis._offset + x}px`, top: `${full._size.t}px`, height: `${full._size.h}px` });
    mark.dataset.time = state.time;
  }
}
function moveTo(time) {
  const t = episode().time;
  state.time = Math.min(Math.max(time, t[0]), t[t.length - 1]);
  $("time").value = state.time;
  $("now").textContent = `${state.time.toFixed(2)} s`;
  cursors();
  readout();
  robots();
}
function zoom(factor) {  // about the cursor
  const t = episode().time, first = t[0], last = t[t.length - 1], [low, high] = range ?? [first, last], span = factor * (high - low);
  const from = Math.min(Math.max(state.time - span / 2, first), last - span);
  range = span >= last - first ? null : [from, from + span];
  signals();
  cursors();
}
function keys(event) {
  if (event.target.closest("input, select, button, summary, a") || event.ctrlKey || event.metaKey || event.altKey) return;
  const t = episode().time, by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (by) moveTo(t[Math.min(Math.max(sample(t, state.time) + by * (event.shiftKey ? 10 : 1), 0), t.length - 1)]);
  else if (event.key === " ") play(!state.playing);
  else return;
  event.preventDefault();
}
let before = null;  // ms, of the frame before
function tick(now) {
  if (!state.playing) return;
  const [low, high] = range ?? [episode().time[0], episode().time[episode().time.length - 1]];
  let next = state.time + (now - (before ?? now)) / 1000 * Number($("speed").value);
  if (next > high || next < low) next = low;
  before = now;
  moveTo(next);
  requestAnimationFrame(tick);
}
function play(on) {
  state.playing = on;
  $("play").textContent = on ? "❚❚ pause" : "▶ play";
  before = null;
  if (on) requestAnimationFrame(tick);
}
function options(id, values, current) {
  $(id).replaceChildren(...values.map(([value, text]) => make("option", text, { value, selected: String(value) === String(current) })));
  $(id).hidden = values.length < 2 && id !== "joint";
}
function select(wanted) {
  const fresh = wanted.episode !== undefined && wanted.episode !== state.episode;
  Object.assign(state, wanted);
  if (!episode().channels.includes(state.channel)) state.channel = episode().channels[0];
  state.joint = sensor().joint;
  if (fresh) { range = null; state.time = start(); }
  options("episode", data.episodes.map((e, k) => [k, e.label]), state.episode);
  options("channel", episode().channels.map(c => [c, c]), state.channel);
  options("joint", sensors().map(s => [s.joint, s.joint]), state.joint);
  const time = episode().time;
  Object.assign($("time"), { min: time[0], max: time[time.length - 1] });
  for (const row of document.querySelectorAll("tr.pick")) row.classList.toggle("picked", row.dataset.key === `${state.episode} ${state.channel} ${state.joint}`);
  signals();
  where();
  moveTo(state.time);
}
function start() {  // where the first model is farthest off in what is held out
  const s = sensor(), e = episode();
  const held = t => e.held_out.some(([begin, end]) => begin <= t && t <= end);
  let best = 0, at = e.held_out[0][0];
  e.time.forEach((t, i) => { const r = Math.abs(s.residual[0][i]); if (r > best && held(t)) { best = r; at = t; } });
  return at;
}
function wire() {
  $("episode").onchange = event => select({ episode: Number(event.target.value) });
  $("channel").onchange = event => select({ channel: event.target.value });
  $("joint").onchange = event => select({ joint: event.target.value });
  const turn = by => { const all = sensors(), k = all.indexOf(sensor()); select({ joint: all[(k + by + all.length) % all.length].joint }); };
  $("previous").onclick = () => turn(-1);
  $("next").onclick = () => turn(1);
  $("play").onclick = () => play(!state.playing);
  $("time").oninput = event => moveTo(Number(event.target.value));
  $("in").onclick = () => zoom(0.5);
  $("out").onclick = () => zoom(2);
  document.onkeydown = keys;
  $("closer").onclick = () => { look.zoom *= 1.25; robots(); };
  $("farther").onclick = () => { look.zoom /= 1.25; robots(); };
  document.querySelectorAll("#robots canvas").forEach(turnable);
  $("signals").on("plotly_click", event => moveTo(event.points[0].x));
  $("signals").on("plotly_relayout", event => {
    if (event["xaxis.autorange"]) range = null;
    else if (event["xaxis.range[0]"] !== undefined) range = [event["xaxis.range[0]"], event["xaxis.range[1]"]];
    else return;
    signals();
    cursors();
  });
  $("where").on("plotly_click", event => { state.time = event.points[0].x; select({ joint: event.points[0].y }); });
  for (const id of ["signals", "where"]) $(id).on("plotly_afterplot", cursors);
  matchMedia("(prefers-color-scheme: dark)").onchange = draw;
  let width = innerWidth;
  window.onresize = () => { if (innerWidth !== width) { width = innerWidth; draw(); } };
}
function draw() {
  select({});
  matrices();
  search();
}

async function main() {
  result = JSON.parse($("result").textContent);
  data = JSON.parse(await unpacked("series"));
  if (data.schema !== SCHEMA) throw new Error(`its explore.json.gz has schema ${data.schema}, and this page shows ${SCHEMA}`);
  document.head.append(make("script", await unpacked("plotly")));
  prepare();
  document.querySelector("main").hidden = false;
  $("about").textContent = (touch ? "Tap a picture to set the cursor. " : "Drag over a picture to zoom, double-click to see all; a click or the arrow keys set the cursor. ")
    + "Play runs over what is zoomed to."
    + (data.stride > 1 ? ` One of ${data.stride} samples is shown.` : "");
  state.channel = episode().channels[0];
  state.time = start();
  tables();
  draw();
  wire();
  document.body.dataset.ready = "yes";
}
main().catch(error => {
  $("trouble").textContent = `This page cannot be shown here (${error}). It needs a browser of 2023 or later; the printed report needs none of this.`;
  $("trouble").hidden = false;
  throw error;
});
